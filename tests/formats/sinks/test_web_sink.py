"""Data that the page of a live session gets."""

from __future__ import annotations

import json
import re
import time
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.results import StationDetection
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    ArtifactUpdate,
    DetectionEvent,
    StateChange,
    TrackingState,
    WarningEvent,
)
from locatk.formats.plots.shapes import COLORS
from locatk.formats.report.theme import DARK_COLORS, DARK_DEVICE_COLORS, PAGE_COLORS
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.shapes import STYLE_NAMES
from locatk.formats.sinks.web.sink import RECENT_EVENTS, TRAIL_POSES, create

SCENE = Scene(
    stations=(Station(2, np.array([-2.0, 0.0, 2.0]), np.eye(3), IDEAL_CALIBRATION),),
    scale="markers",
)
CONTEXT = SinkContext("lighthouse", {"scene.toml": SCENE}, ("a",), status=lambda: {"ok": True})


class Page:
    """Client that keeps all that it gets."""

    def __init__(self, sink: Any, servers: ModuleType) -> None:
        self._address = f"ws://127.0.0.1:{servers.port_of(sink)}/ws"
        self.messages: list[dict[str, Any]] = []
        self._end_s = time.monotonic() + 30

    def __enter__(self) -> Page:
        connect = pytest.importorskip("websockets.sync.client").connect
        self._connection = connect(self._address)
        self._socket = self._connection.__enter__()
        self.hello, self.artifact, self.health = (self.read() for _ in range(3))
        return self

    def __exit__(self, *error: object) -> None:
        self._connection.__exit__(*error)

    def read(self) -> dict[str, Any]:
        assert time.monotonic() < self._end_s, "the expected message does not come"
        message: dict[str, Any] = json.loads(self._socket.recv(timeout=10))
        self.messages.append(message)
        return message

    def read_until(self, kind: str) -> dict[str, Any]:
        """Return the next message of a kind; updates contain no other kind of messages."""
        while (message := self.read())["type"] != kind:
            pass
        return message

    def events(self) -> list[dict[str, Any]]:
        """Return all events that were received in updates."""
        return [e for m in self.messages if m["type"] == "update" for e in m["messages"]]


def test_the_first_messages_are_the_present_state(servers: ModuleType) -> None:
    with servers.running(create, "web://:0", CONTEXT) as sink, Page(sink, servers) as page:
        assert page.hello == {
            "type": "hello",
            "system": "lighthouse",
            "names": ["a"],
            "devices": [],
            "events": [],
        }
        assert page.artifact["type"] == "artifact"
        assert page.artifact["frames"]["floor"]["labels"][0]["text"] == "station 2"
        assert page.health["type"] == "health"


@pytest.mark.slow
def test_updates_have_the_newest_pose_and_all_events(servers: ModuleType) -> None:
    with servers.running(create, "web://:0", CONTEXT) as sink, Page(sink, servers) as page:
        covariance = np.diag([4e-6, 1e-6, 9e-6, 1e-4, 1e-4, 1e-4])
        covariance[0, 1] = covariance[1, 0] = 1e-6
        covariance[0, 2] = np.nan
        for k in range(500):
            servers.offer(sink, servers.pose("a", k, covariance=covariance))
            servers.offer(sink, servers.pose("b", k))
            servers.offer(sink, WarningEvent("a", k, SolverWarning("test", f"{k}")))
        last = servers.pose(k=499).time_ns * 1e-9
        while sum(event["type"] == "warning" for event in page.events()) < 500:
            page.read()
        events = page.events()
        warnings = [event["message"] for event in events if event["type"] == "warning"]
        assert warnings == [str(k) for k in range(500)]
        poses = [event for event in events if event["type"] == "pose" and event["device"] == "a"]
        assert poses[-1]["time_s"] == last
        times = [event["time_s"] for event in poses]
        assert times == sorted(times)
        assert len(times) < 100  # of 500: those between two updates are not needed
        assert poses[-1]["covariance_xy_m2"] == 1e-6
        assert poses[-1]["covariance_xz_m2"] is None
        assert poses[-1]["latency_s"] >= 0
        servers.wait_until(lambda: sink.status().sent == len(events))
        assert sink.status().dropped == 0
        assert sink.status().clients == 1
        health = page.read_until("health")
        assert health["status"] == {"ok": True}
        assert set(health["rates_hz"]) == {"a", "b"}


@pytest.mark.slow
def test_a_page_that_opens_later_has_path_state_and_events(servers: ModuleType) -> None:
    with servers.running(create, "web://:0", CONTEXT) as sink:
        with Page(sink, servers) as page:
            for k in range(40):
                # Handed over one by one: the path has a pose each 0.1 s.
                time_ns = servers.START_NS + 100_000_000 * k + 600_000
                servers.offer(sink, servers.pose("a", 10 * k, time_ns=time_ns))
                page.read_until("update")
            servers.offer(sink, StateChange("a", 1, TrackingState.LOST, "no light"))
            detection = StationDetection(0, 2, None, 960_000, "factory", 3, 0)
            servers.offer(sink, DetectionEvent("a", 1, detection))
            for k in range(2 * RECENT_EVENTS):
                servers.offer(sink, WarningEvent("", k, SolverWarning("test", f"{k}")))
            while len(page.events()) < 40 + 2 + 2 * RECENT_EVENTS:
                page.read()
        with Page(sink, servers) as later:
            (device,) = later.hello["devices"]
            assert device["device"] == "a"
            # The path ends with the pose, and not after it: the page would begin a new one.
            assert device["pose"]["time_s"] == device["trail"][-1][0] == time_ns * 1e-9
            # Its age is told, because it is not new; its latency was that of another time.
            assert device["age_s"] > 0
            assert "latency_s" not in device["pose"]
            assert (device["state"]["state"], device["state"]["reason"]) == ("lost", "no light")
            assert device["detection"]["detection"]["channel"] == 2
            assert [point[1] for point in device["trail"]] == pytest.approx(np.arange(40) * 0.1)
            assert {(point[4], point[6]) for point in device["trail"]} == {(0, "floor")}
            messages = [event["message"] for event in later.hello["events"]]
            assert messages == [str(k) for k in range(RECENT_EVENTS, 2 * RECENT_EVENTS)]


@pytest.mark.slow
def test_what_is_remembered_is_bounded(servers: ModuleType) -> None:
    sink = create(servers.parse_address("web://:0"))
    items = [servers.queued(servers.pose("a", 10 * k)) for k in range(2 * TRAIL_POSES)]
    sink.observe(items)
    hello = json.loads(next(iter(sink.greet(None))))
    assert len(hello["devices"][0]["trail"]) == TRAIL_POSES
    sink.observe([servers.queued(servers.pose(f"device {k}")) for k in range(3000)])
    assert len(json.loads(next(iter(sink.greet(None))))["devices"]) == 1000


def test_a_new_artifact_and_new_frames_are_sent(servers: ModuleType) -> None:
    with servers.running(create, "web://:0", CONTEXT) as sink, Page(sink, servers) as page:
        servers.offer(sink, ArtifactUpdate(5, 3, Scene(scale="markers"), "station moved"))
        artifact = page.read_until("artifact")
        assert artifact["version"] == 3
        assert artifact["frames"]["floor"]["shapes"] == []
        servers.offer(sink, servers.pose(frame="elsewhere"))
        assert "elsewhere" in page.read_until("artifact")["frames"]
        servers.wait_until(lambda: page.read() and len(page.events()) >= 2)
        (event,) = [event for event in page.events() if event["type"] == "artifact"]
        assert (event["version"], event["reason"]) == (3, "station moved")


def test_the_page_may_only_run_its_own_script(servers: ModuleType) -> None:
    with servers.running(create, "web://:0", CONTEXT) as sink:
        for path, kind in (
            ("/", "text/html"),
            ("/app.js", "text/javascript"),
            ("/app.css", "text/css"),
        ):
            status, headers, body = servers.request(sink, path)
            assert status == 200
            assert headers["Content-Type"].startswith(kind)
            assert headers["X-Content-Type-Options"] == "nosniff"
            assert int(headers["Content-Length"]) == len(body.encode())
            policy = dict(
                part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; ")
            )
            assert policy["default-src"] == "'none'"
            assert policy["script-src"] == policy["style-src"] == "'self'"
            assert policy["frame-ancestors"] == policy["base-uri"] == "'none'"
            # Neither another server nor inline code, which the policy would forbid.
            assert not re.search(r"https?://|<script>|<style|\son\w+=|\sstyle=", body)
            assert "innerHTML" not in body


def test_colors_are_those_of_reports(servers: ModuleType) -> None:
    with servers.running(create, "web://:0", CONTEXT) as sink:
        css = servers.request(sink, "/app.css")[2]
    light, dark = (
        dict(re.findall(r"--([\w-]+): (#\w+);", part))
        for part in css.partition("@media (max-width")[0].split("@media (prefers-color-scheme")
    )
    assert set(light) == set(dark)
    for name, colors in PAGE_COLORS.items():
        assert (light[name], dark[name]) == colors
    for k, pair in enumerate(zip(COLORS, DARK_DEVICE_COLORS, strict=True)):
        assert (light[f"d{k}"], dark[f"d{k}"]) == pair
    for style, name in STYLE_NAMES.items():
        assert light[name].lower() == style.color.lower()
        counterpart = DARK_COLORS.get(style.color.lower(), "#d0d7de")
        assert dark[name] == counterpart


def luminance(color: str) -> float:
    channels = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_states_have_enough_contrast(servers: ModuleType) -> None:
    """Of text: 4.5 to 1 (WCAG 2.2, success criterion 1.4.3)."""
    with servers.running(create, "web://:0", CONTEXT) as sink:
        css = servers.request(sink, "/app.css")[2]
    for part in css.partition("@media (max-width")[0].split("@media (prefers-color-scheme"):
        colors = dict(re.findall(r"--([\w-]+): (#\w+);", part))
        pairs = [(name, f"{name}-fill") for name in ("good", "fair", "carried", "bad")]
        pairs += [(name, "card") for name in ("good", "fair", "carried", "bad", "muted", "ink")]
        pairs += [("muted", "page"), ("muted", "grid"), ("card", "link")]
        for first, second in pairs:
            low, high = sorted(luminance(colors[each]) for each in (first, second))
            assert (high + 0.05) / (low + 0.05) >= 4.5, (first, second)
