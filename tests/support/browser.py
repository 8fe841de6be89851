"""A headless Chromium, driven through its debugging pipe: what a page looks like and complains about, at any width, offline."""

from __future__ import annotations

import base64
import itertools
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
PATIENCE = 60.0
CHECK = """
(() => {
  const page = document.documentElement;
  const outside = [...document.querySelectorAll("main *, header *, nav *")].filter((one) => {
    const box = one.getBoundingClientRect();
    return box.width && box.right > page.clientWidth + 1 && !one.closest(".scroll, .panel, pre, svg, .hidden");
  });
  return {
    width: page.clientWidth, needed: page.scrollWidth, height: page.scrollHeight,
    broken: [...document.images].filter((one) => !one.complete || !one.naturalWidth).map((one) => one.alt),
    silent: [...document.images].filter((one) => !one.alt).length,
    outside: outside.slice(0, 5).map((one) => one.tagName + " " + one.className + " " + one.textContent.slice(0, 40)),
    loaded: performance.getEntriesByType("resource").map((one) => one.name).filter((name) => !name.startsWith("data:")),
  };
})()
"""


def chromium():
    """The browser, if there is one."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Browser:
    """`with Browser() as browser:`; pages are opened without network, or with `served=True` from this machine alone."""

    def __init__(self, *, served=False, webgl=False, patience=PATIENCE):
        self._served, self._webgl, self._patience = served, webgl, patience

    def __enter__(self):
        program = chromium()
        assert program is not None
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        to_browser, ours = os.pipe()
        theirs, from_browser = os.pipe()
        # Without a GPU a scene is drawn by software.
        graphics = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"] if self._webgl else ["--disable-gpu"]
        options = ["--headless", "--no-sandbox", *graphics, "--remote-debugging-pipe", "--no-first-run", "--hide-scrollbars"]
        options += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]
        # The browser reads from descriptor 3 and writes to 4.
        command = f'exec "$0" "$@" 3<&{to_browser} 4>&{from_browser}'
        self._process = subprocess.Popen(
            ["/bin/bash", "-c", command, program, *options, f"--user-data-dir={self._folder.name}", "about:blank"],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._write, self._read, self._numbers, self._buffer = ours, theirs, itertools.count(1), b""
        self.events: list[dict[str, Any]] = []
        self._target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=self._target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.online(self._served)
        return self

    def __exit__(self, *_):
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
        os.close(self._write)
        os.close(self._read)
        self._folder.cleanup()

    def call(self, method, **parameters):
        """Send a command of the DevTools protocol; returns its result."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if getattr(self, "_session", None) and not method.startswith("Target."):
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._message()
            if answer.get("id") == number:
                assert "error" not in answer, answer
                result = answer["result"]
                return result

    def _message(self):
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], self._patience)
            assert ready, "the browser does not answer"
            part = os.read(self._read, 1 << 20)
            assert part, "the browser has ended"
            self._buffer += part
        text, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(text)
        if "method" in message:
            self.events.append(message)
        return message

    def online(self, yes):
        """Enable or disable the network for pages."""
        limits = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        self.call("Network.emulateNetworkConditions", offline=not yes, **limits)

    def open(self, page, width, height=900):
        """Show a file or an address in a window of a size in CSS pixels; below 600 as a phone does."""
        self.events.clear()
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600)
        self.call("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self._message()

    def run(self, script):
        """The value of an expression in the page."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, script, seconds=PATIENCE):
        """The value of an expression in the page, once it is true."""
        end = time.monotonic() + seconds
        while not (value := self.run(script)):
            assert time.monotonic() < end, f"not true after {seconds} s: {script}"
            time.sleep(0.05)
        return value

    def drag(self, *places):
        """Press the mouse at the first place of the window, CSS pixels, move it over the others, release it at the last one."""
        for kind, (x, y) in [("mouseMoved", places[0]), ("mousePressed", places[0])]:
            self._mouse(kind, x, y)
        for x, y in places[1:]:
            self._mouse("mouseMoved", x, y, 1)
        self._mouse("mouseReleased", *places[-1])

    def click(self, selector):
        """Click the middle of an element."""
        box = self.run(f"JSON.parse(JSON.stringify(document.querySelector({json.dumps(selector)}).getBoundingClientRect()))")
        self.drag((box["x"] + box["width"] / 2, box["y"] + box["height"] / 2))

    def _mouse(self, kind, x, y, buttons=0):
        pressed = {
            "button": "none" if kind == "mouseMoved" else "left",
            "clickCount": int(kind != "mouseMoved"),
            "buttons": buttons,
        }
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **pressed)

    def key(self, key, modifiers=0):
        """Press and release a key, as `KeyboardEvent.key` names it; modifiers: 2 control, 8 shift."""
        text = {"text": key} if len(key) == 1 and not modifiers & 2 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers, **(text if kind == "keyDown" else {}))

    def check(self):
        """Faults of the page: `CHECK` after all images are decoded, and its log as `errors`."""
        self.run("document.querySelectorAll('details').forEach((fold) => (fold.open = true))")
        self.run("document.querySelectorAll('img').forEach((one) => (one.loading = 'eager'))")
        self.run("Promise.allSettled([...document.images].map((one) => one.decode()))")
        found = self.run(CHECK)
        logged = [event["params"]["entry"]["text"] for event in self.events if event["method"] == "Log.entryAdded"]
        raised = [str(event["params"]) for event in self.events if event["method"] == "Runtime.exceptionThrown"]
        asked = [event["params"]["request"]["url"] for event in self.events if event["method"] == "Network.requestWillBeSent"]
        return found | {"errors": logged + raised, "asked": [url for url in asked if not url.startswith(("data:", "file:"))]}

    def screenshot(self, path):
        """The window as PNG."""
        width, height = self.run("[document.documentElement.clientWidth, document.documentElement.scrollHeight]")
        clip = {"x": 0, "y": 0, "width": width, "height": min(900, height), "scale": 1}
        # A scene that is drawn by software is not drawn again for a picture of the window alone.
        answer = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=not self._webgl, clip=clip)
        path.write_bytes(base64.b64decode(answer["data"]))
