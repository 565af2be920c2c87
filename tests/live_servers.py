"""Messages, sinks and a browser for the tests of servers."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import re
import shutil
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.streaming.events import LiveEvent, PoseEstimate, TrackingState
from locatk.formats.sinks.addresses import parse_address
from locatk.formats.sinks.interface import LiveMessage, SinkContext
from locatk.formats.sinks.server import QueuedMessage, ServerSink

START_NS = 1_767_225_600_000_000_000

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def pose(device: str = "a", k: int = 0, **changes: Any) -> PoseEstimate:
    """Return pose number k of a device."""
    values: dict[str, Any] = {
        "frame": "floor",
        "time_ns": START_NS + k * 10_000_000,
        "position": np.array([0.01 * k, 0.5, 0.0]),
        "quaternion": np.array([0.0, 0.0, 0.6, 0.8]),
        "covariance": np.diag([4e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4]),
        "state": TrackingState.TRACKING,
    }
    return PoseEstimate(device, **(values | changes))


def offer(sink: ServerSink, event: LiveEvent) -> None:
    """Offer an event that was received just now."""
    sink.offer(LiveMessage(event, time.monotonic()))


@contextlib.contextmanager
def running(
    create: Callable[..., Any], text: str, context: SinkContext | None = None
) -> Iterator[Any]:
    """Run the sink of an address."""
    sink = create(parse_address(text))
    sink.open(context or SinkContext("lighthouse"))
    try:
        yield sink
    finally:
        sink.close(1.0)


def port_of(sink: ServerSink) -> int:
    """Return the port of a running sink."""
    match = re.search(r":(\d+)/", sink.url)
    assert match is not None
    return int(match[1])


def request(
    sink: ServerSink, path: str, headers: dict[str, str] | None = None
) -> tuple[int, dict[str, str], str]:
    """Send a GET request to the loopback interface; return status, headers and body."""
    url = f"http://127.0.0.1:{port_of(sink)}{path}"
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(urllib.request.Request(url, headers=headers or {}), timeout=10) as answer:
            return answer.status, dict(answer.headers), answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read().decode()


def wait_until(condition: Callable[[], Any], timeout_s: float = 20.0) -> Any:
    """Wait until a condition is true, and return its value."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.01)
    raise AssertionError("the condition did not become true")


class Browser:
    """Headless Chromium with one page, controlled by the DevTools protocol."""

    def __init__(self, profile: Path, *switches: str) -> None:
        found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
        if found is None:
            pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
        from websockets.sync.client import connect

        self._process = subprocess.Popen(
            [
                found,
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
                "--disable-background-networking",
                "--hide-scrollbars",
                "--remote-debugging-port=0",
                f"--user-data-dir={profile}",
                *switches,
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        ports = profile / "DevToolsActivePort"
        wait_until(lambda: ports.exists() and ports.read_text().strip(), 60.0)
        port = ports.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=20) as answer:
            tabs = json.load(answer)
        address = next(tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page")
        self._stack = contextlib.ExitStack()
        self._socket = self._stack.enter_context(connect(address, max_size=None))
        self._numbers = itertools.count(1)
        self.console: list[str] = []
        for method in ("Page.enable", "Runtime.enable", "Log.enable"):
            self.call(method)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("id") == number:
                assert "error" not in message, message
                result: dict[str, Any] = message["result"]
                return result
            kinds = ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown")
            if message.get("method") in kinds:
                self.console.append(json.dumps(message["params"]))

    def open(self, url: str, width: int = 1300, height: int = 850) -> None:
        """Open an address in a window of this size."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        self.call("Page.navigate", url=url)

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        result = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, expression: str, timeout_s: float = 20.0) -> Any:
        """Wait until a JavaScript expression is true; the page may still be loading."""
        safe = f"(() => {{ try {{ return {expression} }} catch {{ return false }} }})()"
        return wait_until(lambda: self.evaluate(safe), timeout_s)

    def picture(self) -> Any:
        """Return the window as an image (height, width, 3) in r, g, b."""
        cv2 = pytest.importorskip("cv2")
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]

    def close(self) -> None:
        """End the browser."""
        self._stack.close()
        self._process.terminate()
        self._process.wait(20)


def queued(event: PoseEstimate) -> QueuedMessage:
    """Return a pose on its way to clients."""
    return QueuedMessage(LiveMessage(event, time.monotonic()), event.device)
