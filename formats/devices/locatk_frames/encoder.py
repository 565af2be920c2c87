"""A recording as frames of the locatk protocol: what a firmware would have sent."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.lighthouse.channels import CHANNELS
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.formats.devices.locatk_frames import payloads
from locatk.formats.devices.locatk_frames.framing import LARGEST_CONTENT
from locatk.formats.devices.locatk_frames.payloads import FrameWriter, Type
from locatk.formats.devices.recording import Recording

TICK_NS = 1000
"""Nanoseconds of a tick."""

HELLO_NS = 1_000_000_000
"""Time from one HELLO to the next."""

MOST_SAMPLES = 8
MOST_SWEEPS = 16
LONGEST_TICKS = 20_000
"""What one frame holds at most: so many samples or sweeps, of so long."""

Times = NDArray[np.int64]


@dataclass(frozen=True)
class _Unsent:
    """A frame that has no sequence number yet; ``time_ns`` is when it can be sent."""

    time_ns: int
    node: int
    type: Type
    tick: int
    payload: bytes


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Frames of all that a recording holds, in the order of their times.

    Devices become nodes in the order in which they are first named (samples, hall sensors,
    odometry, sweeps): the first is node 0. Ticks are microseconds since the first time of
    all; where samples do not come in even steps, a frame tells them to one tick. Each node
    says HELLO first and then every second.

    Returns
    -------
    iterator of (int, bytes)
        When the last sample of a frame was measured, in ns, and the frame.

    Raises
    ------
    InputError
        The recording is empty, or holds what no frame can tell: more than 256 devices, more
        sensors, a sweep of no channel.
    """
    sampled = _sampled(recording)
    times = [time_ns for _, _, time_ns, _ in sampled]
    if recording.sweeps is not None:
        _check(recording.sweeps)
        times.append(recording.sweeps.time_ns)
    times = [each for each in times if len(each)]
    if not times:
        raise InputError("nothing in the recording that a locatk device sends")
    start_ns = min(int(each.min()) for each in times)
    end_ns = max(int(each.max()) for each in times)
    nodes = _nodes([device for _, device, *_ in sampled], recording.sweeps)
    sources = [_hellos(nodes, start_ns, end_ns)]
    for type, device, time_ns, values in sampled:
        sources.append(_series(type, nodes[device], time_ns, values, start_ns))
    if recording.sweeps is not None:
        for number in np.unique(recording.sweeps.device).tolist():
            node = nodes[recording.sweeps.devices[number]]
            sources.append(_sweeps(recording.sweeps, number, node, start_ns))
    return _sent(sources)


def _sampled(recording: Recording) -> list[tuple[Type, str, Times, NDArray[np.float32]]]:
    """Type, device, times (n,) and values (n, N, ...) of what is sampled."""
    sampled: list[tuple[Type, str, Times, NDArray[np.float32]]] = []
    for samples in recording.samples:
        values = (samples.field_t * 1e6).astype("<f4")
        sampled.append((Type.MAGNETOMETERS, samples.device, samples.time_ns, values))
    for halls in recording.halls:
        values = (halls.field_t * 1e6).astype("<f4")
        sampled.append((Type.HALLS, halls.device, halls.time_ns, values))
    for track in recording.odometry:
        poses = np.column_stack([track.position[:, :2], heading_from_quaternion(track.quaternion)])
        sampled.append((Type.ODOMETRY, track.device, track.time_ns, poses[:, None].astype("<f4")))
    for _, device, _, values in sampled:
        if values.shape[1] > 255:
            raise InputError(f"{values.shape[1]} sensors of {device}, where a frame tells 255")
        if np.isinf(values).any():
            raise InputError(f"an infinite value of {device}, which no frame tells")
    return sampled


def _check(sweeps: Sweeps) -> None:
    """Refuse sweeps that a frame cannot tell."""
    ranges = (
        ("sensor", sweeps.sensor, 0, 255),
        ("channel", sweeps.channel, CHANNELS[0], CHANNELS[-1]),
        ("polynomial", sweeps.polynomial, UNKNOWN, 31),
        ("sweep", sweeps.sweep, UNKNOWN, 1),
        ("count", sweeps.count, 0, payloads.COUNT_END / payloads.COUNT_STEPS - 1),
    )
    for name, values, low, high in ranges:
        wrong = np.flatnonzero(~((values >= low) & (values <= high)))
        if len(wrong):
            raise InputError(f"{name} {values[wrong[0]]} of sweep {wrong[0]}, which no frame tells")


def _nodes(sampled: Sequence[str], sweeps: Sweeps | None) -> dict[str, int]:
    """Devices, and their numbers."""
    seen = () if sweeps is None else np.unique(sweeps.device).tolist()
    devices = [*sampled, *(sweeps.devices[number] for number in seen if sweeps is not None)]
    nodes = {device: number for number, device in enumerate(dict.fromkeys(devices))}
    if len(nodes) > 256:
        raise InputError(f"{len(nodes)} devices, where one port tells 256 apart")
    return nodes


def _sent(sources: list[Iterator[_Unsent]]) -> Iterator[tuple[int, bytes]]:
    writers: dict[int, FrameWriter] = {}
    for unsent in heapq.merge(*sources, key=lambda each: each.time_ns):
        writer = writers.setdefault(unsent.node, FrameWriter(unsent.node))
        yield unsent.time_ns, writer.frame(unsent.type, unsent.tick, unsent.payload)


def _hellos(nodes: dict[str, int], start_ns: int, end_ns: int) -> Iterator[_Unsent]:
    for time_ns in range(start_ns, end_ns + 1, HELLO_NS):
        for device, node in nodes.items():
            payload = payloads.hello(1_000_000_000 // TICK_NS, device)
            yield _Unsent(time_ns, node, Type.HELLO, (time_ns - start_ns) // TICK_NS, payload)


def _series(
    type: Type, node: int, time_ns: Times, values: NDArray[np.float32], start_ns: int
) -> Iterator[_Unsent]:
    """Samples in frames of even steps."""
    ticks = ((time_ns - start_ns) // TICK_NS).tolist()
    most = max(1, min(MOST_SAMPLES, (LARGEST_CONTENT - 16) // (4 * values[:1].size)))
    start = 0
    while start < len(ticks):
        stop, step = _even(ticks, start, most)
        payload = payloads.series(values[start:stop], step)
        yield _Unsent(int(time_ns[stop - 1]), node, type, ticks[start], payload)
        start = stop


def _even(ticks: list[int], start: int, most: int) -> tuple[int, int]:
    """Where the samples from ``start`` on end that one frame can tell, and their step."""
    first, stop = ticks[start], start + 1
    if stop == len(ticks) or most == 1 or not 0 < ticks[stop] - first <= LONGEST_TICKS:
        return stop, 0
    step = ticks[stop] - first
    while (
        stop < min(len(ticks), start + most)
        and ticks[stop] - first <= LONGEST_TICKS
        and abs(first + (stop - start) * step - ticks[stop]) <= 1
    ):
        stop += 1
    return stop, step


def _sweeps(sweeps: Sweeps, device: int, node: int, start_ns: int) -> Iterator[_Unsent]:
    """Sweeps of one device, in the order of their times."""
    mine = np.flatnonzero(sweeps.device == device)
    mine = mine[np.argsort(sweeps.time_ns[mine], kind="stable")]
    ticks = (sweeps.time_ns[mine] - start_ns) // TICK_NS
    start = 0
    while start < len(mine):
        stop = int(np.searchsorted(ticks, ticks[start] + LONGEST_TICKS, "right"))
        stop = min(stop, start + MOST_SWEEPS)
        part = mine[start:stop]
        payload = payloads.sweeps(
            ticks[start:stop] & 0xFFFFFFFF,
            sweeps.sensor[part],
            sweeps.channel[part],
            sweeps.polynomial[part],
            sweeps.sweep[part],
            sweeps.count[part],
        )
        time_ns = int(sweeps.time_ns[part[-1]])
        yield _Unsent(time_ns, node, Type.LIGHTHOUSE_SWEEP, int(ticks[start]), payload)
        start = stop
