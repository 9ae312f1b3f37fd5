"""What `--realtime` asks of the system: every part in a process of its own, so that this one stays ordinary."""

import json
import os
import subprocess
import sys

import pytest

ASK = """
import json, os
from companion import realtime
{before}
found = realtime.prepare()
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
reading, writing = os.pipe()
child = os.fork()
if child == 0:
    realtime.rejoin()
    os.write(writing, json.dumps([os.sched_getscheduler(0), sorted(os.sched_getaffinity(0))]).encode())
    os._exit(0)
os.waitpid(child, 0)
print(json.dumps({{
    "taken": {{m.name: m.taken for m in found}},
    "sentences": [m.sentence for m in found],
    "fifo": os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO,
    "locked_kb": int(status["VmLck"].split()[0]),
    "cores": len(os.sched_getaffinity(0)),
    "child": json.loads(os.read(reading, 4096)),
}}))
"""


def asked(before="") -> dict:
    command = [sys.executable, "-c", ASK.format(before=before)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_what_is_said_is_what_holds():
    found = asked()
    assert found["fifo"] == found["taken"]["scheduling class"]
    assert (found["locked_kb"] > 0) == found["taken"]["memory"]
    assert (found["cores"] == 1) == (found["taken"]["cores"] or len(os.sched_getaffinity(0)) == 1)
    assert found["taken"]["timer slack"]
    assert len(found["sentences"]) == 4


def test_a_child_is_ordinary_again():
    scheduler, cores = asked()["child"]
    assert scheduler == os.SCHED_OTHER
    assert cores == sorted(os.sched_getaffinity(0))


@pytest.mark.skipif(os.geteuid() != 0, reason="gives up root's capabilities")
def test_without_permission_it_says_what_is_missing_and_goes_on():
    give_up = (
        "import resource; resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536));"
        " resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0)); os.setgid(65534); os.setuid(65534)"
    )
    found = asked(give_up)
    assert not found["taken"]["scheduling class"]
    assert not found["taken"]["memory"]
    said = "\n".join(found["sentences"])
    for remedy in ("CAP_SYS_NICE", "ulimit -r", "CAP_IPC_LOCK", "ulimit -l"):
        assert remedy in said


def test_one_core_leaves_nothing_to_choose():
    found = asked("os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})")
    assert not found["taken"]["cores"]
    assert any("one core only" in sentence for sentence in found["sentences"])
