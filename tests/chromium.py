"""A headless Chromium, driven through a pipe by its DevTools protocol."""

import base64
import contextlib
import io
import json
import os
import select
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_OPTIONS = (
    "--headless", "--no-sandbox", "--remote-debugging-pipe", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--window-size=800,600", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage",
)  # fmt: skip


def found() -> str | None:
    """Path of a Chromium of this machine."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


needed = pytest.mark.skipif(
    found() is None, reason=f"no browser on the PATH, looked for {', '.join(NAMES)}"
)


class Tab:
    """One page, with what it complained of and asked the network for."""

    def __init__(self, into: int, out: int, limit: float):
        self._into, self._out, self._until = into, out, time.monotonic() + limit
        self._rest, self._number, self._session = b"", 0, None
        self.errors: list[str] = []
        self.requests: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._into, json.dumps(message).encode() + b"\0")
        while (answer := self._read()).get("id") != self._number:
            self._note(answer)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def run(self, script: str) -> Any:
        """Value of an expression of the page; promises are waited for."""
        done = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in done:
            raise RuntimeError(f"{script}: {done['exceptionDetails']}")
        return done["result"].get("value")

    def wait(self, script: str) -> None:
        """Until an expression is true."""
        while not self.run(script):
            time.sleep(0.05)

    def picture(self) -> np.ndarray:
        """Pixels after the next two frames."""
        from PIL import Image

        self.run("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    def _note(self, event: dict[str, Any]) -> None:
        kind, params = event.get("method"), event.get("params", {})
        if kind == "Runtime.exceptionThrown" or (
            kind == "Log.entryAdded" and params["entry"]["level"] == "error"
        ):
            self.errors.append(json.dumps(params)[:500])
        elif kind == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning"):
            self.errors.append(json.dumps(params["args"])[:500])
        elif kind == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            left = self._until - time.monotonic()
            if left <= 0 or not select.select([self._out], [], [], left)[0]:
                raise TimeoutError("Chromium gave no answer in time")
            content = os.read(self._out, 1 << 20)
            if not content:
                raise RuntimeError("Chromium has ended")
            self._rest += content
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)


@contextlib.contextmanager
def tab(limit: float = 120.0) -> Iterator[Tab]:
    """A page of a Chromium of its own, which ends with the block."""
    program = found()
    assert program is not None
    to_read, into = os.pipe()
    out, to_write = os.pipe()
    with tempfile.TemporaryDirectory() as profile:
        actions = [
            (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
            (os.POSIX_SPAWN_DUP2, 1, 2),
            # Out of the way of the numbers 3 and 4 first.
            (os.POSIX_SPAWN_DUP2, to_read, 63), (os.POSIX_SPAWN_DUP2, to_write, 64),
            (os.POSIX_SPAWN_DUP2, 63, 3), (os.POSIX_SPAWN_DUP2, 64, 4),
            (os.POSIX_SPAWN_CLOSE, 63), (os.POSIX_SPAWN_CLOSE, 64),
        ]  # fmt: skip
        arguments = [program, *_OPTIONS, f"--user-data-dir={profile}", "about:blank"]
        process = os.posix_spawn(
            program, arguments, dict(os.environ), file_actions=actions, setpgroup=0
        )
        os.close(to_read)
        os.close(to_write)
        try:
            yield Tab(into, out, limit)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)
            os.close(into)
            os.close(out)
            time.sleep(0.2)  # its children let go of the profile
