"""A real browser driven over its pipe: pages from a file, scripts, mouse and keys, pictures, what
it complains of.
"""

import base64
import json
import os
import select
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

from browser import BROWSER

FLAGS = ("--headless=new", "--no-sandbox", "--no-first-run", "--hide-scrollbars",
         "--remote-debugging-pipe",
         "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
         "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1")  # fmt: skip


class Driven:
    """One page of the browser. `complaints`: console errors and exceptions; `requested`: URLs asked
    for.
    """

    def __init__(self, send, receive, group):
        self.group = group
        self._send, self._receive = send, receive
        self._number, self._held, self._session = 0, b"", None
        self.complaints, self.requested = [], []

    def call(self, method, timeout=60, **parameters):
        self._number += 1
        number = self._number
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._send, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + timeout
        while True:
            answer = self._next(until)
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def _next(self, until):
        while b"\0" not in self._held:
            if not select.select([self._receive], [], [], max(until - time.monotonic(), 0))[0]:
                raise TimeoutError("the browser does not answer")
            chunk = os.read(self._receive, 1 << 20)
            if not chunk:
                raise EOFError("the browser is gone")
            self._held += chunk
        message, _, self._held = self._held.partition(b"\0")
        answer = json.loads(message)
        method, given = answer.get("method"), answer.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(given["exceptionDetails"])[:500])
        elif method == "Runtime.consoleAPICalled" and given["type"] in (
            "error",
            "warning",
            "assert",
        ):
            self.complaints.append(json.dumps(given["args"])[:500])
        elif method == "Log.entryAdded" and given["entry"]["level"] in ("error", "warning"):
            self.complaints.append(given["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requested.append(given["request"]["url"])
        elif method == "Page.loadEventFired":
            self._loaded = True
        return answer

    def open(self, page, width, height, dark=False):
        """A file's path, or a URL of this machine."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.size(width, height)
        theme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[theme])
        self._loaded = False
        self.call("Page.navigate", url=page if isinstance(page, str) else page.as_uri())
        until = time.monotonic() + 60
        while not self._loaded:
            self._next(until)

    def size(self, width, height):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def run(self, script):
        """What an expression gives, awaited."""
        done = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in done:
            raise RuntimeError(json.dumps(done["exceptionDetails"])[:1000])
        return done["result"].get("value")

    def mouse(self, kind, x, y, **more):
        self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **more)

    def click(self, x, y):
        for kind in ("Moved", "Pressed", "Released"):
            self.mouse(
                kind, x, y, **({} if kind == "Moved" else {"button": "left", "clickCount": 1})
            )

    def drag(self, start, end, steps=8):
        self.mouse("Moved", *start)
        self.mouse("Pressed", *start, button="left", buttons=1, clickCount=1)
        for k in range(1, steps + 1):
            at = [a + (b - a) * k / steps for a, b in zip(start, end, strict=True)]
            self.mouse("Moved", *at, button="left", buttons=1)
        self.mouse("Released", *end, button="left", clickCount=1)

    def key(self, name, down):
        self.call("Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", key=name)

    def cpu_seconds(self, kind=""):
        """Of all its processes so far, or of those of a kind: renderer, gpu-process."""
        spent, wanted = 0.0, f"--type={kind}" if kind else ""
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
                ours = int(fields[3]) == self.group and wanted in (folder / "cmdline").read_text()
            except (OSError, IndexError):
                continue
            spent += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") if ours else 0
        return spent

    def screenshot(self, path):
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))


@contextmanager
def driven(folder):
    """A browser of its own profile below `folder`, ended with all its processes."""
    ours, theirs = os.pipe(), os.pipe()  # of commands, of answers
    command = [BROWSER, *FLAGS, f"--user-data-dir={folder}/profile"]
    # the browser reads commands from descriptor 3 and answers on 4
    shell = ["bash", "-c", f'exec "$@" 3<&{ours[0]} 4>&{theirs[1]}', "browser", *command]
    with open(folder / "browser.log", "w") as log_file:
        process = subprocess.Popen(
            shell, pass_fds=(ours[0], theirs[1]), stdin=subprocess.DEVNULL, stdout=log_file,
            stderr=log_file,
            start_new_session=True,
        )  # fmt: skip
    os.close(ours[0])
    os.close(theirs[1])
    try:
        yield Driven(ours[1], theirs[0], process.pid)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        os.close(ours[1])
        os.close(theirs[0])
