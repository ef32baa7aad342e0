"""Tests drive a headless Chromium by mouse and keys over its debugging pipe (Chrome DevTools).

The pipe needs no package and no port: messages are JSON and end in a null byte.
"""

import base64
import fcntl
import io
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
FLAGS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--remote-debugging-pipe", "--hide-scrollbars",
)  # fmt: skip
# longest wait for an answer or a condition [s]
PATIENCE = 30.0


class Browser:
    """A page in its own browser; as a context it ends the browser."""

    def __init__(self, page: Path, size: tuple[int, int] = (600, 700)):
        """Open a page in a window of ``width`` x ``height`` pixels."""
        # pipes from the browser and to the browser
        ours, theirs = os.pipe(), os.pipe()
        read, write = (fcntl.fcntl(fd, fcntl.F_DUPFD, 20) for fd in (theirs[0], ours[1]))
        profile, url = page.with_suffix(".profile"), page.as_uri()
        words = [str(CHROMIUM), *FLAGS, f"--user-data-dir={profile}"]
        # the browser reads file 3 and writes file 4
        shell = ["bash", "-c", f'exec "$@" 3<&{read} 4>&{write}', "bash"]
        self._process = subprocess.Popen(
            [*shell, *words, f"--window-size={size[0]},{size[1]}"], pass_fds=(read, write),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        for fd in (theirs[0], ours[1], read, write):
            os.close(fd)
        self._from, self._to, self._rest = ours[0], theirs[1], b""
        self._number, self._session = 0, ""
        window: dict[str, Any] = {"newWindow": True, "width": size[0], "height": size[1]}
        try:
            target = self._ask("Target.createTarget", url=url, **window)
            session = self._ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)
            self._session = session["sessionId"]
            self.until("document.documentElement?.dataset.ready === '1'")
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *_: object) -> None:
        for fd in (self._to, self._from):
            os.close(fd)
        self._process.terminate()
        self._process.wait(PATIENCE)

    def _ask(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command and return its answer; events of the browser before it are dropped."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        message |= {"sessionId": self._session} if self._session else {}
        os.write(self._to, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + PATIENCE
        while True:
            text, null, rest = self._rest.partition(b"\0")
            if null:
                self._rest, answer = rest, json.loads(text)
                if answer.get("id") == self._number:
                    assert "error" not in answer, answer
                    return answer["result"]
                continue
            assert select.select([self._from], [], [], max(0.0, end - time.monotonic()))[0], (
                f"no answer to {method}"
            )
            more = os.read(self._from, 2**20)
            assert more, "the browser ended"
            self._rest += more

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        answer = self._ask(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def until(self, expression: str) -> None:
        """Wait until a JavaScript expression is true."""
        end = time.monotonic() + PATIENCE
        while not self.value(expression):
            assert time.monotonic() < end, f"it never came that {expression}"
            time.sleep(0.05)

    def middle(self, selector: str) -> tuple[float, float]:
        """Return the position of the middle of an element [px]."""
        box = self._box(selector)
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def _box(self, selector: str) -> dict[str, float]:
        """Return the corner, the width and the height of an element [px]."""
        element = f"document.querySelector({json.dumps(selector)})"
        return self.value(f"{element}.getBoundingClientRect().toJSON()")

    def _mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self._ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(
        self, start: tuple[float, float], by: tuple[float, float], shift: bool = False
    ) -> None:
        """Drag by these pixels in ten steps with the left button, with the shift key or without."""
        held: dict[str, Any] = {"button": "left", "modifiers": 8 if shift else 0}
        self._mouse("mousePressed", *start, buttons=1, clickCount=1, **held)
        for share in np.linspace(0.1, 1, 10):
            x, y = start[0] + share * by[0], start[1] + share * by[1]
            self._mouse("mouseMoved", x, y, buttons=1, **held)
        self._mouse("mouseReleased", start[0] + by[0], start[1] + by[1], clickCount=1, **held)

    def click(self, at: str | tuple[float, float]) -> None:
        """Click on the middle of an element, or on a point."""
        self.drag(self.middle(at) if isinstance(at, str) else at, (0, 0))

    def wheel(self, at: tuple[float, float], down: float) -> None:
        """Turn the mouse wheel by so many pixels downwards."""
        self._mouse("mouseWheel", *at, deltaX=0, deltaY=down)

    def key(self, key: str) -> None:
        """Press and release a key."""
        self._ask("Input.dispatchKeyEvent", type="keyDown", key=key)
        self._ask("Input.dispatchKeyEvent", type="keyUp", key=key)

    def picture(self, selector: str = "#view") -> np.ndarray:
        """Return the picture (h, w, 3) of an element after the page has drawn."""
        drawn = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
        self.value(drawn)
        box = self._box(selector)
        clip = {name: box[name] for name in ("x", "y", "width", "height")} | {"scale": 1}
        data = self._ask("Page.captureScreenshot", clip=clip)["data"]
        return np.array(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(int)
