"""MAVProxy without a screen, as a process of its own, against the vehicle's ground link."""

import importlib.util
import queue
import subprocess
import sys
import threading
import time

import pytest
from client_tools import vehicle

PLAN = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.397742\t8.545594\t489.4\t1
1\t0\t3\t22\t0\t0\t0\t0\t47.397742\t8.545594\t5\t1
2\t0\t3\t16\t0\t0\t0\t0\t47.39780\t8.545594\t6\t1
3\t0\t3\t21\t0\t0\t0\t0\t47.397742\t8.545594\t0\t1
"""
START = "import sys; from importlib.metadata import distribution as d; import runpy; "
START += "path = next(f.locate() for f in d('MAVProxy').files if f.name == 'mavproxy.py'); "
START += "sys.argv[0] = str(path); runpy.run_path(str(path), run_name='__main__')"


class Console:
    """MAVProxy's console: commands in, lines out."""

    def __init__(self, master, folder, *more):
        options = ["--master", master, "--state-basedir", str(folder), *more]
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-c", START, *options, "--logfile", str(folder / "mav.tlog")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=folder,
        )
        self.lines = []
        self._new = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self._new.put(line)

    def wait(self, *words, seconds=20.0):
        """Wait for a line with each of the words, in any order; gives the lines since the last wait."""
        end, seen = time.monotonic() + seconds, []
        missing = set(words)
        while missing:
            try:
                line = self._new.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                pytest.fail(f"no {sorted(missing)} from MAVProxy; it said: {''.join(self.lines[-40:])}")
            self.lines.append(line)
            seen.append(line)
            missing -= {word for word in missing if word in line}
        return "".join(seen)

    def do(self, command, *words):
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        return self.wait(*words)

    def close(self):
        self.process.terminate()
        try:
            self.process.communicate(timeout=5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()


@pytest.mark.skipif(importlib.util.find_spec("MAVProxy") is None, reason="MAVProxy is not installed")
def test_parameters_modes_arming_and_waypoints(tmp_path):
    plan = tmp_path / "plan.txt"
    plan.write_text(PLAN)
    with vehicle("--param", "COM_DISARM_PRFLT=-1", speed=2.0) as ready:
        console = Console(f"udpin:127.0.0.1:{ready['ground_remote_port']}", tmp_path)
        try:
            console.wait("Detected vehicle 1:1", "Mode LOITER", "parameters to")
            console.do("param fetch", "Requested parameter list", "parameters to")
            saved = (tmp_path / "mav.parm").read_text()
            assert saved.count("\n") > 120
            assert "MPC_THR_HOVER" in saved
            console.do("param set MPC_XY_CRUISE 3.5")
            for _ in range(20):
                if "MPC_XY_CRUISE    3.5" in console.do("param show MPC_XY_CRUISE", "MPC_XY_CRUISE "):
                    break
                time.sleep(0.2)
            else:
                pytest.fail("the parameter was not set")
            console.do("mode", "Available modes:")
            console.do("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED", "ARMED")
            console.do("disarm", "DISARMED")
            console.do(f"wp load {plan}", "Sent all 4 waypoints", "MISSION_ACK: TYPE_MISSION: ACCEPTED")
            listed = console.do("wp list", "Saved waypoints")
            assert "22 3 47.3977420000 8.5455940000 5.000000" in listed
            assert "21 3 47.3977420000 8.5455940000 0.000000" in listed
            console.do("mode 4", "Mode MISSION")  # by number: its way of sending names does not fit PX4's modes
            console.do("long NAV_RETURN_TO_LAUNCH 0 0 0 0 0 0 0", "Mode RTL")
        finally:
            console.close()
