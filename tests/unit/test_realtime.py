"""What is asked of the system, with and without `--realtime`: each in a process of its own; this one stays ordinary."""

import json
import os
import resource
import subprocess
import sys

import pytest

from companion import realtime

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


PRIORITY = """
import json, os, threading
from companion import realtime
{before}
taken = realtime.take_priority()
reading, writing = os.pipe()
child = os.fork()
if child == 0:
    os.write(writing, str(os.getpriority(os.PRIO_PROCESS, 0)).encode())
    os._exit(0)
os.waitpid(child, 0)
threads = []
thread = threading.Thread(target=lambda: threads.append(os.getpriority(os.PRIO_PROCESS, 0)))
thread.start()
thread.join()
print(json.dumps([taken, os.getpriority(os.PRIO_PROCESS, 0), int(os.read(reading, 99)), threads[0]]))
"""


def priorities(before="") -> list:
    command = [sys.executable, "-c", PRIORITY.format(before=before)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def priority_permitted() -> bool:
    """Whether this process may have more priority, by another program's word."""
    return subprocess.run(["nice", "-n", "-15", "true"], capture_output=True, check=False).stderr == b""


ORDINARY = "os.geteuid() or (os.setgid(65534), os.setuid(65534))"
"""A process of root's becomes one of nobody's."""


@pytest.mark.skipif(not priority_permitted(), reason="this process may not have more priority")
def test_priority_is_for_the_calling_thread_alone():
    assert priorities() == [True, realtime.NICENESS, 0, 0]


@pytest.mark.skipif(not priority_permitted(), reason="this process may not have more priority")
def test_more_priority_is_not_given_up():
    assert priorities("os.nice(-15)")[:2] == [True, -15]


def test_priority_that_is_not_permitted_is_not_taken():
    give_up = f"import resource; resource.setrlimit(resource.RLIMIT_NICE, (0, 0)); {ORDINARY}"
    taken, after, child, thread = priorities(give_up)
    assert not taken
    assert after == child == thread == os.getpriority(os.PRIO_PROCESS, 0)


@pytest.mark.skipif(resource.getrlimit(resource.RLIMIT_NICE)[1] < 30, reason="the limit cannot be raised here")
def test_a_nice_limit_is_enough():
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_NICE, (30, 30)); {ORDINARY}"
    assert priorities(limited)[:2] == [True, realtime.NICENESS]
