"""A real browser to test pages in: Debian's chromium without a window, spoken to over its DevTools pipe."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome")
PATIENCE_S = 60.0
FLAGS = (
    *("--headless=new", "--remote-debugging-pipe", "--no-first-run", "--no-default-browser-check"),
    *("--disable-gpu", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage", "--hide-scrollbars"),
    *("--disable-extensions", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-default-apps", "--metrics-recording-only", "--mute-audio"),
)
START = """
import fcntl, os, sys
into, out = (fcntl.fcntl(int(number), fcntl.F_DUPFD, 10) for number in sys.argv[1:3])
os.dup2(into, 3)
os.dup2(out, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""The browser reads requests from descriptor 3 and answers on 4."""


def installed() -> str | None:
    """The path of a chromium; None without one."""
    return next((path for name in NAMES if (path := shutil.which(name)) is not None), None)


class BrowserError(Exception):
    """The browser does not answer, or the page raised."""


class Chromium:
    """A browser with one page; a context manager."""

    def __init__(self, program: str) -> None:
        self._profile = tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True)
        into, self._requests = os.pipe()
        self._answers, out = os.pipe()
        # Chromium's sandbox needs a user that is not root.
        sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
        command = [program, *FLAGS, *sandbox, f"--user-data-dir={self._profile.name}", "about:blank"]
        self._process = subprocess.Popen(
            [sys.executable, "-S", "-c", START, str(into), str(out), *command],
            pass_fds=(into, out),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(into)
        os.close(out)
        self._buffer = b""
        self._number = 0
        self._session: str | None = None
        self.complaints: list[str] = []
        """What the pages wrote to the console as errors and warnings, and exceptions that nobody caught."""
        self._loaded = False

    def __enter__(self) -> Chromium:
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._requests)  # the browser ends when the pipe does
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        os.close(self._answers)
        self._profile.cleanup()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Ask something of the browser, and wait for the answer."""
        self._number += 1
        request: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            request["sessionId"] = self._session
        content = json.dumps(request).encode() + b"\0"
        while content:
            content = content[os.write(self._requests, content) :]
        end_s = time.monotonic() + PATIENCE_S
        while True:
            message = self._receive(end_s, method)
            if message.get("id") == self._number:
                if "error" in message:
                    raise BrowserError(f"{method}: {message['error']['message']}")
                return dict(message["result"])

    def _receive(self, end_s: float, what: str) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready = select.select([self._answers], [], [], max(0.0, end_s - time.monotonic()))[0]
            content = os.read(self._answers, 1 << 20) if ready else b""
            if not content:
                raise BrowserError(f"{what}: the browser {'has ended' if ready else 'does not answer'}")
            self._buffer += content
        content, _, self._buffer = self._buffer.partition(b"\0")
        message = dict(json.loads(content))
        self._note(message)
        return message

    def _note(self, message: dict[str, Any]) -> None:
        method, content = message.get("method"), message.get("params", {})
        if method == "Page.loadEventFired":
            self._loaded = True
        elif method == "Runtime.exceptionThrown":
            details = content["exceptionDetails"]
            self.complaints.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Runtime.consoleAPICalled" and content["type"] in {"error", "warning", "assert"}:
            said = " ".join(str(part.get("value", part.get("description", ""))) for part in content["args"])
            self.complaints.append(f"console.{content['type']}: {said}")
        elif method == "Log.entryAdded" and content["entry"]["level"] == "error":
            self.complaints.append(f"{content['entry']['source']}: {content['entry']['text']}")

    def size(self, width_px: int, height_px: int, *, phone: bool = False) -> None:
        """Give the page this size; a phone has a touch screen and two dots per pixel."""
        scale = 2 if phone else 1
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width_px,
            height=height_px,
            deviceScaleFactor=scale,
            mobile=phone,
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        media = [{"name": "pointer", "value": "coarse" if phone else "fine"}]
        self.call("Emulation.setEmulatedMedia", media="", features=media)

    def open(self, path: Path) -> float:
        """Open a file, wait until it is loaded and its scripts have run, and return how long that took [s]."""
        self._loaded = False
        begin_s = time.monotonic()
        self.call("Page.navigate", url=path.resolve().as_uri())
        while not self._loaded:
            self._receive(begin_s + PATIENCE_S, f"opening {path.name}")
        # Two frames later the first drawing is on the screen.
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
        return time.monotonic() - begin_s

    def run(self, script: str) -> Any:
        """The value of an expression in the page, after a promise is kept.

        Raises:
            BrowserError: the script raised.
        """
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise BrowserError(details.get("exception", {}).get("description", details["text"]))
        return answer["result"].get("value")

    def picture(self, path: Path, *, whole: bool = True) -> Path:
        """A screenshot (PNG) of the whole page, or of what is visible."""
        answer = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(answer["data"]))
        return path

    def print(self, path: Path) -> Path:
        """The page as it is printed (PDF, A4)."""
        answer = self.call("Page.printToPDF", printBackground=True, paperWidth=8.27, paperHeight=11.69)
        path.write_bytes(base64.b64decode(answer["data"]))
        return path
