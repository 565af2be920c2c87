"""Web page of a live session: ``web://[host]:port`` serves the page, its data, and ``/health``.

The page is one file each of HTML, CSS and JavaScript in this folder; nothing else is loaded. It
gets JSON over a WebSocket at ``/ws``: first ``hello`` with all that is known, then ``update`` with
the newest messages of :mod:`.json_messages` at most 30 times a second, and ``health`` each second.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

from locatk.core.streaming.events import (
    ArtifactUpdate,
    DetectionEvent,
    PoseEstimate,
    StateChange,
    TrackingState,
)
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import LiveMessage, SinkContext
from locatk.formats.sinks.json_messages import event_to_json
from locatk.formats.sinks.server import (
    Client,
    QueuedMessage,
    Resource,
    ServerSink,
    to_json_text,
)
from locatk.formats.sinks.shapes import artifact_to_json, find_artifact

DEFAULT_PORT = 8080

UPDATE_INTERVAL_S = 1 / 30
"""Time between two updates of a page: eyes do not see more."""

HEALTH_INTERVAL_S = 1.0
"""Time between two reports of the health. The page takes the connection for lost without three."""

TRAIL_INTERVAL_NS = 100_000_000
"""Time between two poses of the path that a page gets when it opens."""

TRAIL_POSES = 600
"""Number of these poses of each device: a minute."""

RECENT_EVENTS = 100
"""Number of events that a page gets when it opens."""

MAX_REMEMBERED_DEVICES = 1000
"""Number of devices that a page gets when it opens; it bounds the memory."""

FILES = {
    "/": ("app.html", "text/html; charset=utf-8"),
    "/app.js": ("app.js", "text/javascript; charset=utf-8"),
    "/app.css": ("app.css", "text/css; charset=utf-8"),
}
"""File and content type by path."""


@dataclass
class _DeviceRecord:
    """Newest facts about a device, for pages that open later."""

    pose: QueuedMessage | None = None
    state: QueuedMessage | None = None
    detection: QueuedMessage | None = None
    trail: deque[list[Any]] = field(default_factory=lambda: deque(maxlen=TRAIL_POSES))
    trail_ns: int = 0


def create(address: SinkAddress) -> WebSink:
    """Create the sink of an address such as ``web://:8080``."""
    return WebSink(address)


class WebSink(ServerSink):
    """Server of the page."""

    default_port = DEFAULT_PORT
    purpose = "the page of a live session"
    interval_s = UPDATE_INTERVAL_S

    def __init__(self, address: SinkAddress) -> None:
        super().__init__(address)
        self._devices: dict[str, _DeviceRecord] = {}
        self._events: deque[QueuedMessage] = deque(maxlen=RECENT_EVENTS)
        self._artifact: Any = None
        self._artifact_version = 0
        self._artifact_text = ""
        self._frames: dict[str, None] = {}
        self._health_text = "{}"
        self._counts: dict[str, int] = {}
        self._rates: dict[str, float] = {}
        self._files: dict[str, Resource] = {}

    @property
    def url(self) -> str:
        """Address for a browser, with the token behind ``#``, which browsers send to no server."""
        fragment = "" if self.token is None else f"#token={self.token}"
        return f"http://{self.location}/{fragment}"

    def open(self, context: SinkContext) -> None:
        """Start the server; see :meth:`.server.ServerSink.open`."""
        self._artifact = find_artifact(context.artifacts)
        folder = resources.files(__package__)
        for path, (name, content_type) in FILES.items():
            self._files[path] = Resource(content_type, folder.joinpath(name).read_bytes())
        super().open(context)

    def offer(self, message: LiveMessage) -> None:
        """Take a message; see :class:`.interface.Sink`."""
        event = message.event
        if isinstance(event, PoseEstimate):
            # Poses are counted before those that the page does not need are left out.
            self._counts[event.device] = self._counts.get(event.device, 0) + 1
        super().offer(message)

    def is_socket(self, path: str) -> bool:
        """Return whether the path is that of the page's data."""
        return path == "/ws"

    def resource(self, path: str, host: str) -> Resource | None:
        """Return a file of the page, which runs only scripts of this server and loads only data."""
        file = self._files.get(path)
        if file is None:
            return None
        body = file.body
        if self.token is not None:
            body = body.replace(b'data-token="none"', b'data-token="required"')
        # Some browsers do not count WebSockets as 'self'.
        policy = (
            "default-src 'none'; script-src 'self'; style-src 'self'; "
            f"connect-src 'self' ws://{host} wss://{host}; img-src 'self' data:; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        return Resource(file.content_type, body, policy)

    def observe(self, items: list[QueuedMessage]) -> None:
        """Remember what pages that open later need."""
        frames = len(self._frames)
        for item in items:
            event = item.message.event
            if isinstance(event, ArtifactUpdate):
                self._artifact, self._artifact_version = event.artifact, event.version
                self._artifact_text = ""
            if isinstance(event, PoseEstimate):
                self._frames.setdefault(event.frame)
                self._remember_pose(item, event)
                continue
            self._events.append(item)
            if isinstance(event, StateChange):
                self._record(event.device).state = item
            elif isinstance(event, DetectionEvent):
                self._record(event.device).detection = item
        if len(self._frames) != frames:
            self._artifact_text = ""
            for client in self.clients:
                client.request("artifact")

    def _record(self, device: str) -> _DeviceRecord:
        record = self._devices.get(device)
        if record is None:
            record = _DeviceRecord()
            if len(self._devices) < MAX_REMEMBERED_DEVICES:
                self._devices[device] = record
        return record

    def _remember_pose(self, item: QueuedMessage, pose: PoseEstimate) -> None:
        record = self._record(pose.device)
        record.pose = item
        if abs(pose.time_ns - record.trail_ns) >= TRAIL_INTERVAL_NS:
            record.trail_ns = pose.time_ns
            x, y, z = pose.position.round(4).tolist()
            state = list(TrackingState).index(pose.state)
            record.trail.append(
                [pose.time_ns * 1e-9, x, y, z, state, pose.reset_counter, pose.frame]
            )

    def greet(self, client: Client) -> Iterable[str]:
        """Yield the present state of all devices, the artifact and the health."""
        devices = [
            {
                "device": name,
                "age_s": None if record.pose is None else record.pose.message.latency_s(),
                **{
                    key: _past(item)
                    for key in ("pose", "state", "detection")
                    if (item := getattr(record, key)) is not None
                },
                "trail": list(record.trail),
            }
            for name, record in self._devices.items()
        ]
        hello = {
            "type": "hello",
            "system": self.context.system,
            "names": list(self.context.devices),
            "devices": devices,
            "events": [_past(item) for item in self._events],
        }
        yield to_json_text(hello)
        yield self._artifact_message()
        yield self._health_message()

    def encode(
        self, client: Client, items: list[QueuedMessage], requests: set[str]
    ) -> Iterator[str]:
        """Yield the artifact if it changed, the messages as one frame, and the health."""
        is_updated = any(isinstance(item.message.event, ArtifactUpdate) for item in items)
        if is_updated or "artifact" in requests:
            yield self._artifact_message()
        if items:
            texts = ",".join([_encode(item) for item in items])
            yield f'{{"type":"update","messages":[{texts}]}}'
            client.sent += len(items)
        if "health" in requests:
            yield self._health_message()

    def _artifact_message(self) -> str:
        if not self._artifact_text:
            drawing = artifact_to_json(self._artifact, self._frames)
            message = {"type": "artifact", "version": self._artifact_version, **drawing}
            self._artifact_text = to_json_text(message)
        return self._artifact_text

    def _health_message(self) -> str:
        rates = to_json_text(self._rates)
        return f'{{"type":"health","rates_hz":{rates},"status":{self._health_text}}}'

    async def run(self) -> None:
        """Send the health and the rates of poses each second."""
        loop = asyncio.get_running_loop()
        last_s, last_counts = loop.time(), dict(self._counts)
        while True:
            await asyncio.sleep(HEALTH_INTERVAL_S)
            now_s, counts = loop.time(), self._counts.copy()
            self._rates = {
                device: round((count - last_counts.get(device, 0)) / (now_s - last_s), 1)
                for device, count in counts.items()
            }
            last_s, last_counts = now_s, counts
            if self.clients:
                self._health_text = to_json_text(self.health())
            for client in self.clients:
                client.request("health")


def _encode(item: QueuedMessage) -> str:
    """Return a message as JSON; it is made once for all clients."""
    text = item.encoded.get("json")
    if text is None:
        table = _fields(item, item.message.latency_s())
        text = item.encoded["json"] = to_json_text(table)
    return text


def _past(item: QueuedMessage) -> dict[str, Any]:
    """Return the fields of a message of the past, without a latency."""
    return _fields(item, None)


def _fields(item: QueuedMessage, latency_s: float | None) -> dict[str, Any]:
    """Return the fields of a message; poses with the covariances that ellipses need."""
    event = item.message.event
    table = event_to_json(event, latency_s)
    if isinstance(event, PoseEstimate):
        table["covariance_xy_m2"] = float(event.covariance[0, 1])
        table["covariance_xz_m2"] = float(event.covariance[0, 2])
    return table
