"""A headless Chromium over its DevTools protocol: what a page asks for, shows, and does when keys are pressed."""

import base64
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-sync"),
    *("--disable-component-update", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--mute-audio"),
    *("--remote-debugging-port=0", "--window-size=640,420"),
)


def wait_until(holds: Callable[[], Any], seconds: float = 60.0) -> Any:
    """What `holds` returns once that is true; an assertion fails after so many seconds."""
    end = time.monotonic() + seconds
    while not (found := holds()):
        assert time.monotonic() < end, f"not within {seconds:g} s"
        time.sleep(0.05)
    return found


class Tab:
    """One page, its requests and its complaints."""

    def __init__(self, url: str):
        self._socket: ClientConnection = connect(url, max_size=None)
        self._number = 0
        self.requests: dict[str, str] = {}  # by id: url
        self.failed: list[str] = []
        self.errors: list[str] = []
        for domain in ("Network", "Page", "Runtime"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a command; events that arrive meanwhile are noted."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self._note(message.get("method"), message.get("params", {}))

    def _note(self, event: str | None, told: dict[str, Any]) -> None:
        if event == "Network.requestWillBeSent":
            self.requests[told["requestId"]] = told["request"]["url"]
        elif event == "Network.webSocketCreated":
            self.requests[told["requestId"]] = told["url"]
        elif event == "Network.loadingFailed":
            self.failed.append(f"{self.requests.get(told['requestId'])}: {told['errorText']}")
        elif event == "Network.responseReceived" and told["response"]["status"] >= 400:
            self.failed.append(f"{told['response']['url']}: {told['response']['status']}")
        elif event == "Runtime.exceptionThrown":
            self.errors.append(told["exceptionDetails"].get("exception", {}).get("description", "?"))

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def draw(self) -> None:
        """Waits until all that the page knows by now has been drawn."""
        twice = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
        self.call("Runtime.evaluate", expression=twice, awaitPromise=True)

    @property
    def text(self) -> str:
        """What can be read on the page."""
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    @property
    def fields(self) -> str:
        """What stands in the text fields of the page."""
        return self.evaluate("[...document.querySelectorAll('textarea')].map(field => field.value).join('\\n')") or ""

    def press(self, key: str) -> None:
        """A key, down and up."""
        code = "Space" if key == " " else f"Key{key.upper()}"
        number = ord(key.upper())
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code, windowsVirtualKeyCode=number)

    def click(self, text: str) -> None:
        """Clicks with the mouse on the button, tab, checkbox, choice or field with exactly this text, once it is there."""
        script = (
            "(() => { for (const e of document.querySelectorAll('button, [role=tab], [role=option], label, input')) {"
            f" if ((e.innerText.trim() || e.value) !== {json.dumps(text)} || !e.getClientRects().length) continue;"
            " const box = e.closest('div').parentElement.querySelector('input[type=checkbox]');"
            " const target = e.tagName === 'LABEL' && box ? box : e;"
            " target.scrollIntoView({block: 'center'}); const b = target.getBoundingClientRect();"
            " return [b.x + b.width / 2, b.y + b.height / 2]; } return null; })()"
        )

        def at_rest() -> Any:
            """Where it is, once the page has come to rest around it."""
            before = self.evaluate(script)
            time.sleep(0.2)
            return before if before == self.evaluate(script) else None

        self.click_at(wait_until(at_rest))

    def click_at(self, pixel: tuple[float, float]) -> None:
        """Clicks there."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self._mouse(kind, pixel)

    def write(self, text: str) -> None:
        """Replaces what stands in the field that has been clicked on."""
        self.evaluate("document.activeElement.select()")
        self.call("Input.insertText", text=text)

    def give(self, file: Path) -> None:
        """Chooses a file for the page's only button that takes one."""
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        node = wait_until(lambda: self.call("DOM.querySelector", nodeId=root, selector="input[type=file]")["nodeId"])
        self.call("DOM.setFileInputFiles", nodeId=node, files=[str(file)])

    def drag(self, way: Sequence[tuple[float, float]], release: bool = True) -> None:
        """Presses the mouse at the first pixel of a way and moves it along the others; without release it stays down."""
        self._mouse("mouseMoved", way[0], "none")
        self.draw()  # what lies under the mouse lights up
        self._mouse("mousePressed", way[0])
        for pixel in way[1:]:
            self.draw()
            self._mouse("mouseMoved", pixel)
        if release:
            self.release(way[-1])

    def release(self, pixel: tuple[float, float]) -> None:
        """Lets go of the mouse."""
        self._mouse("mouseReleased", pixel)

    def _mouse(self, kind: str, pixel: tuple[float, float], button: str = "left") -> None:
        x, y = pixel
        down = int(button == "left" and kind != "mouseReleased")
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=down, clickCount=1)

    def picture(self) -> bytes:
        """A PNG of what is seen."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        """Leaves the page."""
        self._socket.close()


class Chromium:
    """The browser; a context that ends it."""

    def __init__(self, profile: Path):
        self._profile = profile

    def __enter__(self) -> "Chromium":
        command = [str(PROGRAM), *FLAGS, f"--user-data-dir={self._profile}", "about:blank"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        # in a session of its own, as where a person starts it: schedulers share the processor out among sessions
        environment = {**os.environ, "HOME": str(self._profile)}
        self._process = subprocess.Popen(command, env=environment, start_new_session=True, **quiet)  # type: ignore[call-overload]
        port_file = self._profile / "DevToolsActivePort"
        wait_until(lambda: port_file.is_file() and len(port_file.read_text().splitlines()) == 2, 60)
        self._port = port_file.read_text().splitlines()[0]
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait(timeout=20)

    def open(self, address: str) -> Tab:
        """A new tab at an address."""
        request = urllib.request.Request(f"http://127.0.0.1:{self._port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=30) as answer:
            tab = Tab(json.load(answer)["webSocketDebuggerUrl"])
        tab.call("Page.navigate", url=address)
        return tab
