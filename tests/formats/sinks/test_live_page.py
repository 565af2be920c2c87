"""The page of a live session in a real browser."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import Correction, StateChange, TrackingState, WarningEvent
from locatk.formats.plots.shapes import COLORS
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.web.sink import create

pytestmark = pytest.mark.slow

EVIL = "<img src=x onerror=\"document.title='pwned'\">"
"""Name of a device that would run a script if it were shown as HTML."""

SCENE = Scene(
    stations=(Station(2, np.array([-1.0, -1.0, 2.0]), np.eye(3), IDEAL_CALIBRATION),),
    markers=(Marker("left", np.array([1.0, 1.0, 0.0])),),
    scale="markers",
)

ROW = "[...document.querySelectorAll('#rows tr')][%d].innerText.replace(/\\s+/g, ' ')"


def context(token: str | None = None) -> SinkContext:
    status = {
        "ok": True,
        "recording": {"file": "run.mcap"},
        "sinks": [{"address": "x:", "dropped": 3}],
    }
    artifacts = {"scene.toml": SCENE}
    return SinkContext("lighthouse", artifacts, (EVIL, "b", "c"), token, lambda: status)


@pytest.fixture(scope="module")
def browser(servers: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    opened = servers.Browser(tmp_path_factory.mktemp("chromium"))
    yield opened
    opened.close()


@pytest.fixture(autouse=True)
def quiet(browser: Any) -> None:
    """Each test looks at the console of its own pages."""
    browser.open("about:blank")
    browser.wait("location.href === 'about:blank'")
    browser.console.clear()


def show(servers: ModuleType, sink: Any) -> None:
    """Offer poses of three devices in different states, and some events."""
    servers.offer(sink, servers.pose(EVIL, position=np.array([0.0, 0.0, 0.1])))
    wide = np.diag([0.01, 0.0025, 0.01, 1, 1, 1e-2])
    carried = {"state": TrackingState.DEAD_RECKONING, "reason": "no light for 0.5 s"}
    position = np.array([0.5, -0.5, 0.2])
    servers.offer(sink, servers.pose("b", position=position, covariance=wide, **carried))
    servers.offer(sink, servers.pose("c", position=np.array([-0.5, 0.5, 0.3])))
    servers.offer(sink, StateChange("c", 2**62, TrackingState.LOST, "covered"))
    servers.offer(sink, Correction("b", 1, np.array([0.03, 0.04, 0.0]), 0.1, EVIL))
    servers.offer(sink, WarningEvent("", 1, SolverWarning("x", f"look at {EVIL}")))


def test_the_page_shows_devices_states_and_events(servers: ModuleType, browser: Any) -> None:
    with servers.running(create, "web://:0", context()) as sink:
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        show(servers, sink)
        browser.wait(f"({ROW % 2}).includes('covered')")
        first, second, third = (browser.evaluate(ROW % k) for k in range(3))
        assert EVIL in first
        assert "tracking" in first
        assert "2.0 mm" in first
        assert "dead reckoning no light for 0.5 s" in second
        assert "0.500 \u22120.500 0.200" in second
        assert "lost covered" in third
        browser.wait("document.querySelectorAll('#events li').length >= 3")
        events = browser.evaluate("document.getElementById('events').innerText")
        assert "corrected by 50 mm, 5.7° (<img" in events
        assert f"look at {EVIL}" in events
        assert "1 of 3 devices tracking" in browser.evaluate("document.body.innerText")
        browser.wait("document.getElementById('facts').innerText.includes('run.mcap')")
        assert browser.evaluate("document.querySelector('#facts .bad').innerText") == "3"
        # Names are texts: nothing was made of them, and nothing was run.
        assert browser.evaluate("document.querySelectorAll('img').length") == 0
        assert browser.evaluate("document.title") == "locatk live"
        assert browser.console == []


def test_devices_behind_a_port_replace_its_name(servers: ModuleType, browser: Any) -> None:
    inputs = SinkContext("lighthouse", {}, ("gateway", "red"))
    with servers.running(create, "web://:0", inputs) as sink:
        browser.open(sink.url)
        browser.wait("document.querySelectorAll('#rows tr').length === 2")
        for name in ("gateway-1", "gateway-2"):
            servers.offer(sink, servers.pose(name))
        browser.wait("document.getElementById('rows').innerText.includes('gateway-2')")
        names = "[...document.querySelectorAll('#rows tr td')].map((each) => each.innerText)"
        rows = [text.strip() for text in browser.evaluate(names)]
        assert {"red", "gateway-1", "gateway-2"} <= set(rows)
        assert "gateway" not in rows
        browser.wait("document.body.innerText.includes('2 of 3 devices tracking')")
        assert browser.console == []


def fraction(image: Any, color: str, tolerance: int = 12) -> float:
    channels = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    return float(np.mean(np.abs(image.astype(np.int16) - channels).max(axis=-1) < tolerance))


def test_the_map_is_drawn_and_grey_when_poses_are_old(servers: ModuleType, browser: Any) -> None:
    with servers.running(create, "web://:0", context()) as sink:
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        show(servers, sink)
        browser.wait(f"({ROW % 1}).includes('dead reckoning')")
        drawn = int(browser.evaluate("document.body.dataset.drawn"))
        browser.wait(f"Number(document.body.dataset.drawn) > {drawn + 1}")
        box = "JSON.stringify(document.getElementById('canvas').getBoundingClientRect())"
        edges = json.loads(browser.evaluate(box))
        area = slice(int(edges["top"]), int(edges["bottom"])), slice(0, int(edges["right"]))
        image = browser.picture()[area]
        assert fraction(image, COLORS[0]) > 1e-4  # The first device,
        assert fraction(image, COLORS[1]) > 1e-4  # the second,
        assert fraction(image, COLORS[2]) < 2e-5  # not the lost one,
        assert fraction(image, "#333333") > 1e-4  # and the station.
        # No pose follows.
        browser.wait(f"({ROW % 0}).includes('old: tracking')")
        drawn = int(browser.evaluate("document.body.dataset.drawn"))
        browser.wait(f"Number(document.body.dataset.drawn) > {drawn + 1}")
        image = browser.picture()[area]
        assert fraction(image, COLORS[0]) < 2e-5
        assert "0 of 3 devices tracking" in browser.evaluate("document.body.innerText")
        assert browser.console == []


def test_a_lost_connection_is_shown_and_made_again(servers: ModuleType, browser: Any) -> None:
    with servers.running(create, "web://:0", context()) as sink:
        port = servers.port_of(sink)
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        show(servers, sink)
        browser.wait(f"({ROW % 0}).includes('tracking')")
    browser.wait("document.body.dataset.connection === 'lost'")
    banner = "document.getElementById('banner').innerText"
    assert "Connection lost" in browser.evaluate(banner)
    browser.wait(f"({ROW % 0}).includes('old: tracking')")
    with servers.running(create, f"web://:{port}", context()) as sink:
        browser.wait("document.body.dataset.connection === 'live'")
        assert browser.evaluate("document.getElementById('banner').hidden")
        # Nothing of the time before is shown as if it were of now.
        browser.wait(f"({ROW % 0}).includes('no pose yet')")
        show(servers, sink)
        browser.wait(f"({ROW % 0}).includes('tracking')")


def test_a_silent_server_counts_as_lost(
    servers: ModuleType, browser: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as one behind a network that fails: no end of the connection arrives."""
    monkeypatch.setattr("locatk.formats.sinks.web.sink.HEALTH_INTERVAL_S", 1e9)
    with servers.running(create, "web://:0", context()) as sink:
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        browser.wait("document.body.dataset.connection === 'lost'")
        assert browser.console == []


def test_a_page_needs_the_token_of_its_address(servers: ModuleType, browser: Any) -> None:
    with servers.running(create, "web://:0", context("s3cret")) as sink:
        browser.open(sink.url.partition("#")[0])
        browser.wait("document.getElementById('banner').innerText.includes('needs a token')")
        time.sleep(0.2)
        assert sink.status().clients == 0
        assert browser.console == []
        browser.open("about:blank")
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")


def test_keys_and_buttons_change_the_view(servers: ModuleType, browser: Any) -> None:
    with servers.running(create, "web://:0", context()) as sink:
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        show(servers, sink)
        browser.wait(f"({ROW % 1}).includes('dead reckoning')")

        def picture() -> Any:
            drawn = int(browser.evaluate("document.body.dataset.drawn"))
            browser.wait(f"Number(document.body.dataset.drawn) > {drawn + 1}")
            return browser.evaluate("document.getElementById('canvas').toDataURL()")

        browser.wait(f"({ROW % 0}).includes('old')")
        # Names of devices have the age of their poses.
        browser.evaluate("document.getElementById('labels').click()")
        before = picture()
        assert picture() == before
        browser.evaluate("document.getElementById('canvas').focus()")
        for key in ("+", "ArrowLeft"):
            browser.call("Input.dispatchKeyEvent", type="keyDown", key=key)
            after = picture()
            assert after != before
            before = after
        browser.call("Input.dispatchKeyEvent", type="keyDown", key="f")
        fitted = picture()
        browser.evaluate("document.getElementById('plane').click()")
        assert picture() != fitted
        browser.evaluate("document.querySelectorAll('button.name')[1].click()")
        assert browser.evaluate("document.getElementById('follow').value") == "b"
        pressed = "[...document.querySelectorAll('button.name')].map(b => b.ariaPressed).join()"
        assert browser.evaluate(pressed) == "false,true,false"
        assert browser.console == []


def test_the_map_shows_the_frame_with_poses(servers: ModuleType, browser: Any) -> None:
    with servers.running(create, "web://:0", context()) as sink:
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        frame = "document.getElementById('frame')"
        assert browser.evaluate(f"{frame}.value + {frame}.hidden") == "floortrue"
        servers.offer(sink, servers.pose("b", frame="elsewhere"))
        browser.wait(f"{frame}.value === 'elsewhere' && !{frame}.hidden")
        servers.offer(sink, servers.pose("c", frame="floor"))
        browser.wait(f"({ROW % 2}).includes('tracking')")
        assert browser.evaluate(f"{frame}.value") == "elsewhere"
        browser.evaluate(f"{frame}.value = 'floor'; {frame}.onchange({{target: {frame}}})")
        servers.offer(sink, servers.pose("c", frame="third"))
        text = "document.getElementById('empty')"
        browser.wait(f"!{text}.hidden && {text}.innerText.includes('No device is in this frame')")
        browser.wait(f"[...{frame}.options].some(each => each.value === 'third')")
        assert browser.evaluate(f"{frame}.value") == "floor"
        assert browser.console == []


def test_a_page_that_is_opened_later_shows_the_path(servers: ModuleType, browser: Any) -> None:
    with servers.running(create, "web://:0", context()) as sink:
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        for k in range(10):
            # A path that turns; the poses differ by fractions of a millisecond from 0.1 s.
            position = np.array([0.1 * k, 0.5 * (k % 2), 0.0])
            time_ns = servers.START_NS + 100_000_000 * k + 600_000
            servers.offer(sink, servers.pose("b", position=position, time_ns=time_ns))
            at = f"{0.1 * k:.3f} {0.5 * (k % 2):.3f}"
            browser.wait(f"({ROW % 1}).includes('{at}')")
        # Paths are a little transparent.
        before = fraction(browser.picture(), COLORS[1], 70)
        browser.open("about:blank")
        browser.wait("location.href === 'about:blank'")
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        position = np.array([0.9, 0.5, 0.0])
        servers.offer(sink, servers.pose("b", position=position, time_ns=time_ns + 10_000))
        browser.wait(f"({ROW % 1}).includes('tracking')")
        servers.wait_until(lambda: fraction(browser.picture(), COLORS[1], 70) > 0.8 * before)


def test_a_phone_shows_all_without_scrolling_sideways(servers: ModuleType, browser: Any) -> None:
    with servers.running(create, "web://:0", context()) as sink:
        browser.open(sink.url, width=390, height=844)
        browser.wait("document.body.dataset.connection === 'live'")
        show(servers, sink)
        browser.wait(f"({ROW % 0}).includes('tracking')")
        sizes = "[document.documentElement.scrollWidth, innerWidth].join()"
        assert browser.evaluate(sizes) == "390,390"
        assert "Sigma" in browser.evaluate(
            "getComputedStyle(document.querySelector('#rows td:nth-child(7)'), '::before').content"
        )


def test_injected_code_does_not_run(servers: ModuleType, browser: Any) -> None:
    """Should a script get into the page nevertheless, the policy blocks it."""
    with servers.running(create, "web://:0", context()) as sink, socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        elsewhere = f"http://127.0.0.1:{other.getsockname()[1]}/x.js"
        browser.open(sink.url)
        browser.wait("document.body.dataset.connection === 'live'")
        browser.evaluate(
            "for (const set of [s => s.textContent = 'document.title = \"inline\"', "
            f"s => s.src = '{elsewhere}']) {{ const script = document.createElement('script'); "
            "set(script); document.body.append(script); }"
        )
        servers.wait_until(
            lambda: (
                browser.evaluate("1") and sum("Security Policy" in e for e in browser.console) > 1
            )
        )
        assert browser.evaluate("document.title") == "locatk live"
        other.settimeout(0.2)
        with pytest.raises(TimeoutError):
            other.accept()
