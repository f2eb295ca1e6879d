"""A headless Chromium, spoken to through its pipe by the DevTools protocol, without a port."""

import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

FOUND = shutil.which("chromium") or shutil.which("google-chrome")
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--disable-renderer-backgrounding",
    "--disable-backgrounding-occluded-windows",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--remote-debugging-pipe",
)


class Chromium:
    """One tab; what it says is kept.

    Attributes:
        faults: exceptions and errors on the console.
        requests: addresses asked for.
    """

    def __init__(self, profile: Path, wide: int = 1300, high: int = 900) -> None:
        """Prepare a browser with a profile of its own and a window of so many pixels."""
        self.faults: list[str] = []
        self.requests: list[str] = []
        self._profile, self._size = profile, (wide, high)
        self._last, self._heard, self._session = 0, b"", ""

    def __enter__(self) -> Self:
        (told, self._write), (self._read, answers) = os.pipe(), os.pipe()
        flags = [*_FLAGS, f"--user-data-dir={self._profile}"]
        # Chromium reads from descriptor 3 and writes to 4
        self._process = subprocess.Popen(
            ["bash", "-c", f'exec "$@" 3<&{told} 4>&{answers}', "bash", str(FOUND), *flags],
            pass_fds=(told, answers),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(told)
        os.close(answers)
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.resize(*self._size)
        return self

    def __exit__(self, *raised: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def resize(self, wide: int, high: int, mobile: bool = False) -> None:
        """Give the window so many pixels; a phone's if `mobile`."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=wide,
            height=high,
            deviceScaleFactor=2 if mobile else 1,
            mobile=mobile,
        )

    def open(self, page: Path, place: str = "") -> None:
        """Open a file from disk, and wait until its script has run."""
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=f"{page.as_uri()}{place}")
        self.until("location.protocol === 'file:' && document.readyState === 'complete'")

    def ask(self, script: str) -> Any:
        """The value of an expression in the page."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, script: str, seconds: float = 60) -> None:
        """Wait until an expression in the page is true."""
        end = time.monotonic() + seconds
        while not self.ask(script):
            assert time.monotonic() < end, f"never true: {script}"
            time.sleep(0.05)

    def press(self, key: str) -> None:
        """Press a key; a letter is also sent as its place on the keyboard, which viser asks for."""
        text = {"text": key} if len(key) == 1 else {}
        code = f"Key{key.upper()}" if key.isalpha() and text else key
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, code=code, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key, code=code)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag the mouse from one place to another, pixels."""
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.call(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1,
                clickCount=1,
            )  # fmt: skip

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and wait for its result."""
        self._last += 1
        message = {"id": self._last, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            said = self._next()
            if said.get("id") == self._last:
                assert "error" not in said, (method, said["error"])
                return said["result"]
            self._note(said)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._heard:
            ready, _, _ = select.select([self._read], [], [], 300)
            more = os.read(self._read, 1 << 20) if ready else b""
            assert more, "Chromium has gone silent"
            self._heard += more
        one, self._heard = self._heard.split(b"\0", 1)
        return json.loads(one)

    def _note(self, said: Mapping[str, Any]) -> None:
        event = said.get("params", {})
        if said["method"] == "Runtime.exceptionThrown":
            self.faults.append(json.dumps(event["exceptionDetails"]))
        elif said["method"] == "Log.entryAdded" and event["entry"]["level"] in ("error", "warning"):
            self.faults.append(event["entry"]["text"])
        elif said["method"] == "Runtime.consoleAPICalled":
            self.faults.append(json.dumps(event["args"]))
        elif said["method"] == "Network.requestWillBeSent":
            self.requests.append(event["request"]["url"])
