"""Headless Chromium, driven through the pipe of its DevTools protocol: no other library is needed."""

from __future__ import annotations

import base64
import io
import json
import os
import select
import shutil
import signal
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

PROGRAM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
PATIENCE = 400
"""Seconds for an answer: busy processors compile shaders for minutes."""
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--mute-audio"),
    *("--disable-background-timer-throttling", "--disable-renderer-backgrounding", "--disable-gpu-watchdog"),
    "--force-color-profile=srgb",
)
WEBGPU = (  # SwiftShader for WebGPU and for the canvas that shows it
    *("--enable-unsafe-webgpu", "--enable-features=Vulkan", "--use-vulkan=swiftshader"),
    *("--use-angle=swiftshader", "--use-webgpu-adapter=swiftshader", "--enable-unsafe-swiftshader"),
)
WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


class Browser:
    """A Chromium process; ``page`` opens pages in it."""

    def __init__(self, flags: Sequence[str] = WEBGPU) -> None:
        assert PROGRAM is not None
        self._profile = tempfile.mkdtemp(prefix="meshsplats-chromium-")
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()
        # Chromium reads its protocol from descriptor 3 and writes it to 4; high numbers do not collide.
        high = [os.dup(theirs_in), os.dup(theirs_out)]
        null = os.open(os.devnull, os.O_RDWR)
        actions = [
            (os.POSIX_SPAWN_DUP2, null, 0),
            (os.POSIX_SPAWN_DUP2, null, 1),
            (os.POSIX_SPAWN_DUP2, null, 2),
            (os.POSIX_SPAWN_DUP2, high[0], 100),
            (os.POSIX_SPAWN_DUP2, high[1], 101),
            (os.POSIX_SPAWN_DUP2, 100, 3),
            (os.POSIX_SPAWN_DUP2, 101, 4),
        ]
        arguments = [PROGRAM, *FLAGS, *flags, "--remote-debugging-pipe", f"--user-data-dir={self._profile}"]
        self.pid = os.posix_spawn(PROGRAM, arguments, dict(os.environ), file_actions=actions, setpgroup=0)
        for descriptor in (theirs_in, theirs_out, null, *high):
            os.close(descriptor)
        self._in, self._out = ours_in, ours_out
        self._buffer = b""
        self._count = 0
        self.events: list[dict[str, Any]] = []

    def close(self) -> None:
        os.close(self._out)
        os.close(self._in)
        for number in (signal.SIGTERM, signal.SIGKILL):
            try:
                os.killpg(self.pid, number)
            except ProcessLookupError:
                break
            deadline = time.monotonic() + 5
            while time.monotonic() < deadline and os.waitpid(self.pid, os.WNOHANG) == (0, 0):
                time.sleep(0.02)
            break
        shutil.rmtree(self._profile, ignore_errors=True)

    def send(self, method: str, session: str | None = None, timeout: float = 60, **parameters: Any) -> dict:
        """The result of a command of the protocol."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._out, data) :]
        deadline = time.monotonic() + timeout
        while True:
            reply = self._receive(deadline)
            if reply.get("id") == message["id"]:
                if "error" in reply:
                    raise RuntimeError(f"{method}: {reply['error']['message']}")
                return reply["result"]
            self.events.append(reply)

    def _receive(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._in], [], [], max(0, deadline - time.monotonic()))
            if not ready:
                raise TimeoutError("Chromium does not answer")
            data = os.read(self._in, 1 << 20)
            if not data:
                raise ConnectionError("Chromium has ended")
            self._buffer += data
        line, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(line)

    def page(self, url: str, width: int = 400, height: int = 400, **media: Any) -> Page:
        return Page(self, url, width, height, **media)


class Page:
    """A page, ``width`` x ``height`` CSS pixels."""

    def __init__(
        self,
        browser: Browser,
        url: str,
        width: int,
        height: int,
        *,
        ratio: float = 1,
        mobile: bool = False,
        reduced_motion: bool = True,
        before: str = "",
    ) -> None:
        self.browser = browser
        target = browser.send("Target.createTarget", url="about:blank")["targetId"]
        self.target = target
        attached = browser.send("Target.attachToTarget", targetId=target, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.send(f"{domain}.enable")
        self.size(width, height, ratio, mobile)
        value = "reduce" if reduced_motion else "no-preference"
        self.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": value}])
        if before:
            self.send("Page.addScriptToEvaluateOnNewDocument", source=before)
        self.send("Page.navigate", url=url)
        self.wait("document.readyState === 'complete' && location.href !== 'about:blank'")

    def send(self, method: str, timeout: float = PATIENCE, **parameters: Any) -> dict:
        return self.browser.send(method, self.session, timeout, **parameters)

    def size(self, width: int, height: int, ratio: float = 1, mobile: bool = False) -> None:
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=ratio,
            mobile=mobile,
        )
        self.send("Emulation.setTouchEmulationEnabled", enabled=mobile)

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression; promises are awaited."""
        done = self.send(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True, userGesture=True
        )
        if "exceptionDetails" in done:
            raise RuntimeError(str(done["exceptionDetails"].get("exception", done["exceptionDetails"])))
        return done["result"].get("value")

    def wait(self, condition: str, timeout: float = 60) -> None:
        """Until a JavaScript expression is true."""
        deadline = time.monotonic() + timeout
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > deadline:
                state = self.run("document.body.dataset.state + ', ' + document.body.innerText.slice(0, 200)")
                raise TimeoutError(f"{condition} is not true after {timeout} s: {state}")
            time.sleep(0.03)

    def still(self, timeout: float = 60) -> None:
        """Until the image is final."""
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self.wait("document.body.dataset.state === 'still'", timeout)

    def screenshot(self, path: Path | None = None) -> np.ndarray:
        """(h, w, 3) uint8."""
        data = base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])
        if path is not None:
            path.write_bytes(data)
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def key(self, key: str, *, shift: bool = False, hold: float = 0) -> None:
        text = {"text": key} if len(key) == 1 else {}
        named = {"windowsVirtualKeyCode": {"Enter": 13, "Tab": 9, " ": 32}.get(key, 0)}
        modifiers = 8 if shift else 0
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, modifiers=modifiers, **text, **named)
        time.sleep(hold)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key, modifiers=modifiers, **named)

    def choose(self, selector: str, value: str) -> None:
        """Sets a select, slider or colour, as a user's hand does: nothing happens where it has the value."""
        self.run(
            f"(e => {{ if (e.value === {json.dumps(value)}) return; e.value = {json.dumps(value)};"
            " for (const name of ['input', 'change'])"
            " e.dispatchEvent(new Event(name, {bubbles: true})); })"
            f"(document.querySelector({json.dumps(selector)}))"
        )

    def text(self, selector: str) -> str:
        return self.run(f"document.querySelector({json.dumps(selector)}).textContent")

    def statistics(self) -> dict[str, str]:
        """The lines of the page's statistics."""
        terms = "[...document.querySelectorAll('#statistics dt')]"
        return dict(self.run(f"{terms}.map(dt => [dt.textContent, dt.nextElementSibling.textContent])"))

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(
        self, x: float, y: float, dx: float, dy: float, button: str = "left", modifiers: int = 0
    ) -> None:
        bits = {"left": 1, "right": 2}[button]
        more = {"button": button, "buttons": bits, "modifiers": modifiers}
        self.mouse("mousePressed", x, y, clickCount=1, **more)
        for t in (0.5, 1):
            self.mouse("mouseMoved", x + t * dx, y + t * dy, **more)
        self.mouse("mouseReleased", x + dx, y + dy, clickCount=1, **{**more, "buttons": 0})

    def click(self, selector: str) -> None:
        """A click with the mouse on the middle of an element."""
        box = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            " e.scrollIntoView({block: 'nearest'}); const r = e.getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, *box, button="left", clickCount=1, buttons=int(kind == "mousePressed"))

    def touch(self, kind: str, points: Sequence[tuple[float, float]]) -> None:
        self.send(
            "Input.dispatchTouchEvent",
            type=kind,
            touchPoints=[{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)],
        )

    def problems(self) -> list[str]:
        """Errors, warnings of the security policy, exceptions and requests that the page made."""
        found = []
        for event in self.browser.events:
            if event.get("sessionId") != self.session:
                continue
            name, what = event["method"], event["params"]
            if name == "Runtime.exceptionThrown":
                found.append(str(what["exceptionDetails"].get("exception", {}).get("description", what)))
            elif name == "Log.entryAdded" and what["entry"]["level"] in ("error", "warning"):
                found.append(what["entry"]["text"])
            elif name == "Runtime.consoleAPICalled" and what["type"] in ("error", "warning", "assert"):
                found.append(str([part.get("value", part.get("description")) for part in what["args"]]))
        return found

    def requests(self) -> list[str]:
        """Addresses that the page asked for, without data in addresses."""
        sent = [event for event in self.browser.events if event.get("sessionId") == self.session]
        urls = [e["params"]["request"]["url"] for e in sent if e["method"] == "Network.requestWillBeSent"]
        return [url for url in urls if not url.startswith(("data:", "blob:"))]

    def close(self) -> None:
        self.browser.send("Target.closeTarget", targetId=self.target)
