"""Records of a device become messages of a session, with times of the host's clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message
from numpy.typing import NDArray

from locatk.core.clock_sync import TickClock
from locatk.formats.capture.arrival_times import Arrivals
from locatk.formats.capture.device_clock import DeviceTime
from locatk.formats.devices.decoder import Batch, Stream
from locatk.formats.sessions import messages
from locatk.formats.sessions.messages import MAX_BATCH_SAMPLES, Layout

SYSTEMS = {
    "magnetometers": "polaris",
    "halls": "landmarks",
    "lighthouse": "lighthouse",
    "captures": "lighthouse",
}
"""Kind of records to the system that solves them."""

SHORTEST_S = 0.01
"""Of less there is no rate."""

LEVELS = (Log.UNKNOWN, Log.DEBUG, Log.INFO, Log.WARNING, Log.ERROR, Log.FATAL)


@dataclass(frozen=True)
class Stamped:
    """A message on its way into a session: when it was complete, and measured."""

    topic: str
    message: Message
    time_ns: int
    publish_ns: int


class Streams:
    """Messages of the batches that a decoder gives.

    Parameters
    ----------
    name : str
        Of the device; those behind it, if several, are ``<name>-<node>``.
    halls : sequence of str
        Names of the hall sensors in the order that ``halls.toml`` has them; empty where that
        is not known.

    Attributes
    ----------
    samples : Counter
        Records by topic, so far.
    remarks : list of str
        What must be known to use the records.
    """

    def __init__(self, name: str, halls: Sequence[str] = ()) -> None:
        self._name = name
        self._halls = tuple(halls)
        self._doubted: set[tuple[str, ...]] = set()
        self.remarks: list[str] = []
        self._first: dict[str, int] = {}
        self._last: dict[str, int] = {}
        self._times_of: dict[str, DeviceTime] = {}
        self.samples: Counter[str] = Counter()

    def device(self, stream: Stream) -> str:
        """Name of the device whose records these are."""
        return f"{self._name}-{stream.node}" if stream.node else self._name

    def rates(self) -> dict[str, float]:
        """Records a second by topic, from the first to the last."""
        spans = {topic: (self._last[topic] - first) * 1e-9 for topic, first in self._first.items()}
        return {
            topic: (self.samples[topic] - 1) / span
            for topic, span in spans.items()
            if span > SHORTEST_S
        }

    def clocks(self) -> dict[str, TickClock]:
        """By device, of those that tell their ticks and can be believed."""
        return {name: known.clock for name, known in self._times_of.items() if known.rate is None}

    def restart(self) -> None:
        """The devices were away: their clocks may have begun anew."""
        for known in self._times_of.values():
            known.restart()

    def messages(
        self, batches: Sequence[Batch], arrivals: Arrivals, now_ns: int
    ) -> Iterator[Stamped]:
        """Messages of ``batches``, all complete at ``now_ns``; what was measured when, is told
        by the device's ticks where it has any, else by the arrival of the last byte."""
        for batch in batches:
            if len(batch) == 0:
                continue
            if batch.stream.kind == "log":
                yield from self._log(batch, arrivals.read_ns(batch.end), now_ns)
            else:
                yield from self._records(batch, self._times(batch, arrivals), now_ns)

    def _records(self, batch: Batch, time_ns: NDArray[np.int64], now_ns: int) -> Iterator[Stamped]:
        stream, device = batch.stream, self.device(batch.stream)
        topic, layout, once = _form(stream, device)
        time_ns = self._ascending(topic, time_ns)
        self._first.setdefault(topic, int(time_ns[0]))
        self.samples[topic] += len(batch)
        columns: dict[str, NDArray[Any]] = {"time_ns": time_ns, **batch.columns}
        if stream.kind == "halls":
            columns["b_tesla"] = self._in_order(stream.names, columns["b_tesla"])
        if batch.tick is not None:
            columns["device_ticks"] = batch.tick
        if batch.sequence is not None:
            columns["sequence"] = batch.sequence
        for start in range(0, len(batch), MAX_BATCH_SAMPLES):
            part = slice(start, start + MAX_BATCH_SAMPLES)
            message = layout.pack(once, {key: column[part] for key, column in columns.items()})
            yield Stamped(topic, message, now_ns, int(time_ns[start]))

    def _in_order(self, names: tuple[str, ...], field: NDArray[Any]) -> NDArray[Any]:
        """Fields (n, N) of sensors that a device names, in the order of ``halls.toml``."""
        if not names or not self._halls or names == self._halls:
            return field
        if sorted(names) == sorted(self._halls):
            return field[:, [names.index(name) for name in self._halls]]
        if names not in self._doubted:
            self._doubted.add(names)
            self.remarks.append(
                f"hall sensors are named {', '.join(names)}, and in halls.toml "
                f"{', '.join(self._halls)}: they are taken in their order"
            )
        return field

    def _times(self, batch: Batch, arrivals: Arrivals) -> NDArray[np.int64]:
        ticks = batch.stream.ticks
        if batch.tick is None or ticks is None:
            return arrivals.wire_ns(batch.end)
        device = self.device(batch.stream)
        known = self._times_of.get(device)
        if known is None or known.ticks != ticks:
            known = self._times_of[device] = DeviceTime(ticks)
        believed = known.rate is None
        times = known.times(batch.stream.kind, batch.tick, arrivals.read_ns(batch.end))
        if believed and known.rate is not None:
            self.remarks.append(
                f"the clock of {device} runs {known.rate:.2g} times as fast as it says: samples "
                "have the times of their arrival"
            )
        return arrivals.wire_ns(batch.end) if times is None else times

    def _ascending(self, topic: str, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The same times, each later than the one before it by a nanosecond at least."""
        steps = np.arange(len(time_ns))
        last = self._last.get(topic, -1)
        rising = np.maximum.accumulate(np.maximum(time_ns - steps, last + 1)) + steps
        self._last[topic] = int(rising[-1])
        return rising

    def _log(self, batch: Batch, read_ns: NDArray[np.int64], now_ns: int) -> Iterator[Stamped]:
        name = self.device(batch.stream)
        rows = zip(batch.columns["level"], batch.columns["text"], read_ns.tolist(), strict=True)
        for level, text, time_ns in rows:
            stamp = messages.timestamp(time_ns)
            line = Log(timestamp=stamp, level=LEVELS[int(level)], message=str(text), name=name)
            yield Stamped("/log", line, now_ns, time_ns)


def _form(stream: Stream, device: str) -> tuple[str, Layout, dict[str, Any]]:
    """Topic, layout and what is said once of a stream of a device."""
    field: dict[str, Any] = {"device": device, "frame_id": device, "sensors": stream.sensors}
    if stream.kind == "magnetometers":
        return f"/magnetometers/{device}", messages.magnetometers(stream.sensors), field
    if stream.kind == "halls":
        return f"/halls/{device}", messages.halls(stream.sensors), field
    if stream.kind == "lighthouse":
        return f"/lighthouse/{device}", messages.SWEEPS, {"device": device}
    if stream.kind == "captures":
        return f"/captures/{device}", messages.CAPTURES, {"device": device}
    if stream.kind == "odometry":
        once: dict[str, Any] = {"device": device, "frame_id": "odometry"}
        return f"/odometry/{device}", messages.ODOMETRY, once
    if stream.kind == "readings":
        once = {"device": device, "names": stream.names}
        return f"/readings/{device}", messages.readings(len(stream.names)), once
    raise ValueError(f"no such kind of records: {stream.kind}")
