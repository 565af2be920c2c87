"""Simulation of base stations for tests, independent of the solver and of its simulator.

The light planes are those of libsurvive (``survive_reproject_gen2.c``), implemented a second time
in libsurvive's own axes: X right, Y up, viewing along -Z. The stations have factory calibrations
of real units, so that the solver's generic calibration is never exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.calibration import FACTORY_UNITS
from locatk.core.lighthouse.recording import Edges, Sweeps
from locatk.core.lighthouse.scene import Marker, MarkerVisit
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

START_NS = 1_690_000_000_000_000_000

ROTATION_TICKS = dict(
    zip(
        range(1, 17),
        (959000, 957000, 953000, 949000, 947000, 943000, 941000, 939000,
         937000, 929000, 919000, 911000, 907000, 901000, 893000, 887000),
        strict=True,
    )
)  # fmt: skip
"""Duration of a rotation by channel [ticks of 48 MHz]: a copy of Bitcraze's table
(crazyflie-firmware, pulse_processor_v2.c), independent of the package's."""


@dataclass(frozen=True)
class Plane:
    """Factory calibration of one sweep, with libsurvive's names."""

    phase: float = 0.0
    tilt: float = 0.0
    curve: float = 0.0
    gibpha: float = 0.0
    gibmag: float = 0.0
    ogeephase: float = 0.0
    ogeemag: float = 0.0


def planes_of(unit: Array) -> tuple[Plane, Plane]:
    """Convert a row of ``calibration.FACTORY_UNITS`` to both planes."""
    p1, t0, t1, c0, c1, gm0, gm1, gp0, gp1, om0, om1, op0, op1 = map(float, unit)
    return Plane(0.0, t0, c0, gp0, gm0, op0, om0), Plane(p1, t1, c1, gp1, gm1, op1, om1)


def libsurvive_angle(plane: Plane, second: bool, x: Array, y: Array, z: Array) -> Array:
    """Evaluate ``survive_reproject_axis_gen2`` for arrays; x right, y up, z backwards."""
    z = -z
    b = np.arctan2(z, x)
    y_deg = plane.tilt + (-1 if second else 1) * np.pi / 6
    asin_arg = np.tan(y_deg) * y / np.sqrt(x * x + z * z)
    sin_part = np.sin(b - np.arcsin(asin_arg) + plane.ogeephase) * plane.ogeemag
    s = np.arcsin(y / np.sqrt(x * x + y * y + z * z) / np.cos(y_deg))
    mod = np.full_like(s, -8.0108022e-06)
    acc = np.zeros_like(s)
    for f in (0.0028679863, 5.3685255e-06, 0.0076069798, 0.0, 0.0):
        acc = acc * s + mod
        mod = mod * s + f
    bend = sin_part + plane.curve
    asin_arg_2 = asin_arg + mod * bend / (np.cos(y_deg) - acc * bend * np.sin(y_deg))
    out = b - np.arcsin(asin_arg_2)
    return out + np.sin(out + plane.gibpha) * plane.gibmag - plane.phase - np.pi / 2


def look(position: Array, target: Array, roll: float = 0.0) -> Array:
    """Return the rotation, station to world, whose x points from ``position`` to ``target``.

    ``roll`` is the rotation about x in radians.
    """
    forward = np.asarray(target, float) - position
    forward = forward / np.linalg.norm(forward)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    up = np.cross(forward, left)
    cos, sin = np.cos(roll), np.sin(roll)
    return np.stack([forward, cos * left + sin * up, cos * up - sin * left], axis=1)


@dataclass(frozen=True)
class Lamp:
    """Base station."""

    channel: int
    position: Array
    rotation: Array
    planes: tuple[Plane, Plane]

    def angles(self, points: Array) -> Array:
        """Return the rotor angles (m, 2) at which both planes cross world points (m, 3)."""
        forward, left, up = ((points - self.position) @ self.rotation).T
        return np.stack(
            [libsurvive_angle(p, k == 1, -left, up, -forward) for k, p in enumerate(self.planes)],
            axis=-1,
        )

    def counts(self, angles: Array) -> Array:
        """Return the steps of the 6 MHz clock since the rotor's zero.

        The planes point straight ahead after 120 and 240 degrees of the rotation.
        """
        degrees = np.degrees(angles) + [120.0, 240.0]
        return degrees / 360.0 * ROTATION_TICKS[self.channel] / 8


STATION_POSES = {
    1: ((2.6, 1.1, 1.9), 0.03),
    2: ((-2.3, 1.4, 2.2), -0.04),
    5: ((0.4, -2.7, 2.0), 0.02),
    16: ((-0.8, 2.9, 1.7), -0.02),
}
"""Position in metres and roll in radians by channel."""


def lamps(*channels: int, units: tuple[int, ...] = (5, 7, 2, 9)) -> tuple[Lamp, ...]:
    """Return stations on the given channels, around an area of 4 m."""
    stations = []
    for k, channel in enumerate(channels):
        position_m, roll = STATION_POSES[channel]
        position = np.array(position_m)
        rotation = look(position, np.array([0.1 * k, -0.1, 0.1]), roll)
        stations.append(Lamp(channel, position, rotation, planes_of(FACTORY_UNITS[units[k]])))
    return tuple(stations)


def curve(m: int, *, flat: bool, size: float = 0.8) -> Array:
    """Return positions (m, 3) along a winding path in metres, on z = 0 if ``flat``."""
    t = np.linspace(0, 6.0, m)
    z = np.zeros(m) if flat else 0.4 + 0.3 * np.sin(2.3 * t + 0.5)
    return np.stack([size * np.cos(1.1 * t), size * np.sin(1.7 * t + 0.3), z], axis=1)


@dataclass
class Drive:
    """Reports of a receiver, one per position, with one time stamp for all sweeps of a report.

    Tests change ``counts`` (m, s, 2) to inject errors (``nan`` removes a sweep) and then use
    :attr:`sweeps`.
    """

    lamps: tuple[Lamp, ...]
    points: Array
    counts: Array
    time_ns: NDArray[np.int64]
    devices: tuple[str, ...] = ("robot",)
    device: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    labelled: bool = True

    def __post_init__(self) -> None:
        if not len(self.device):
            self.device = np.zeros(len(self.points), np.int32)

    def column(self, channel: int) -> int:
        return [lamp.channel for lamp in self.lamps].index(channel)

    def turned(self, rows: NDArray[np.int64], column: int, plane: int, radians: Array) -> None:
        """Add ``radians`` to the angles of one plane in some rows."""
        per_turn = ROTATION_TICKS[self.lamps[column].channel] / 8
        self.counts[rows, column, plane] += np.asarray(radians) / (2 * np.pi) * per_turn

    @property
    def sweeps(self) -> Sweeps:
        m, s, _ = self.counts.shape
        channel = np.array([lamp.channel for lamp in self.lamps], np.int32)
        received = np.isfinite(self.counts).ravel()
        channels = np.broadcast_to(channel[:, None], (m, s, 2)).ravel()[received]
        n = len(channels)
        return Sweeps(
            devices=self.devices,
            time_ns=np.repeat(self.time_ns, 2 * s)[received],
            device=np.repeat(self.device, 2 * s)[received],
            sensor=np.zeros(n, np.int32),
            channel=channels,
            polynomial=2 * (channels - 1) if self.labelled else np.full(n, -1, np.int32),
            sweep=np.full(n, -1, np.int32),
            count=self.counts.ravel()[received],
        )

    @property
    def truth(self) -> Trajectory:
        return Trajectory.from_positions(self.devices[0], "floor", self.time_ns, self.points)


def drive(
    world: tuple[Lamp, ...],
    points: Array,
    *,
    noise_rad: float = 1e-4,
    step_s: float = 0.1,
    seed: int = 1,
    start_s: float = 0.0,
) -> Drive:
    """Simulate the reports of a receiver at ``points`` (m, 3), one every ``step_s``."""
    rng = np.random.default_rng(seed)
    counts = np.stack(
        [
            lamp.counts(angles + rng.normal(0, noise_rad, angles.shape))
            for lamp in world
            for angles in [lamp.angles(points)]
        ],
        axis=1,
    )
    stamps = START_NS + np.rint((start_s + step_s * np.arange(len(points))) * 1e9).astype(np.int64)
    return Drive(world, points, np.rint(counts), stamps)


def stream(
    world: tuple[Lamp, ...],
    position: Callable[[Array], Array],
    seconds: float,
    *,
    sensors: Array | None = None,
    seed: int = 1,
) -> Sweeps:
    """Simulate every sweep of unsynchronised rotors, at the time at which it crosses.

    ``position`` gives positions (n, 3) at times (n,) in seconds; ``sensors`` (k, 3) are the
    offsets of photodiodes from there.
    """
    rng = np.random.default_rng(seed)
    offsets = np.zeros((1, 3)) if sensors is None else sensors
    parts = []
    for lamp in world:
        period_s = ROTATION_TICKS[lamp.channel] / 48e6
        zero_s = np.arange(rng.uniform(0, period_s), seconds - period_s, period_s)
        for sensor, offset in enumerate(offsets):
            for plane in (0, 1):
                time_s = zero_s + 0.4 * period_s
                for _ in range(4):  # the receiver moves while the rotor rotates
                    count = lamp.counts(lamp.angles(position(time_s) + offset))[:, plane]
                    time_s = zero_s + count / 6e6
                parts.append((time_s, count, lamp.channel, sensor))
    time_s = np.concatenate([p[0] for p in parts])
    count = np.concatenate([p[1] for p in parts])
    channel = np.concatenate([np.full(len(p[0]), p[2], np.int32) for p in parts])
    sensor = np.concatenate([np.full(len(p[0]), p[3], np.int32) for p in parts])
    order = np.argsort(time_s)
    n = len(order)
    return Sweeps(
        devices=("robot",),
        time_ns=START_NS + np.rint(time_s[order] * 1e9).astype(np.int64),
        device=np.zeros(n, np.int32),
        sensor=sensor[order],
        channel=channel[order],
        polynomial=2 * (channel[order] - 1),
        sweep=np.full(n, -1, np.int32),
        count=np.rint(count[order]),
    )


def take(sweeps: Sweeps, rows: NDArray[np.int64]) -> Sweeps:
    """Select sweeps, in the order of ``rows``."""
    names = ("time_ns", "device", "sensor", "channel", "polynomial", "sweep", "count")
    return replace(sweeps, **{name: getattr(sweeps, name)[rows] for name in names})


def join(*parts: Sweeps) -> Sweeps:
    """Concatenate the sweeps of recordings of the same devices."""
    names = ("time_ns", "device", "sensor", "channel", "polynomial", "sweep", "count")
    return replace(
        parts[0], **{name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
    )


def markers_of(world: tuple[Lamp, ...], positions: Array) -> tuple[Marker, ...]:
    """Return markers at positions (k, 3) with the counts that were observed there."""
    markers = []
    for k, position in enumerate(np.asarray(positions, float)):
        counts = {
            lamp.channel: tuple(map(float, lamp.counts(lamp.angles(position[None]))[0]))
            for lamp in world
        }
        markers.append(Marker(f"m{k}", position, (MarkerVisit(counts=counts),)))  # type: ignore[arg-type]
    return tuple(markers)


SQUARE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])


class World:
    """Namespace of the functions above, for tests, which cannot import a conftest."""

    Plane, Lamp, Drive = Plane, Lamp, Drive
    start_ns = START_NS
    square = SQUARE
    ticks = ROTATION_TICKS
    planes_of = staticmethod(planes_of)
    libsurvive_angle = staticmethod(libsurvive_angle)
    look = staticmethod(look)
    lamps = staticmethod(lamps)
    curve = staticmethod(curve)
    drive = staticmethod(drive)
    stream = staticmethod(stream)
    take = staticmethod(take)
    join = staticmethod(join)
    markers_of = staticmethod(markers_of)


@pytest.fixture(scope="session")
def world() -> type[World]:
    """Independent simulation of stations, reports and sweeps."""
    return World


@pytest.fixture(scope="session")
def recordings(data: Path) -> Path:
    """Folder of the published Lighthouse recordings."""
    return data / "lighthouse"


@pytest.fixture(scope="session")
def recorded_tracker(recordings: Path) -> Any:
    """Published recording of a tracker under four stations, with libsurvive's poses."""
    from locatk.formats.importers.libsurvive.recording import read_libsurvive

    path = recordings / "libsurvive" / "tracker-cal-attempt.rec.gz"
    if not path.exists():
        pytest.skip(f"{path} is absent")
    return read_libsurvive([path], stations=True)


# ---- light


@cache
def sequence(polynomial: int) -> NDArray[np.int8]:
    """Return the bits of a polynomial over two periods, generated by its shift register."""
    state, mask = 1, int(lfsr.TAPS[polynomial])
    bits = np.empty(131071, np.int8)
    for k in range(len(bits)):
        bits[k] = state >> 16
        state = (state << 1 | (state & mask).bit_count() & 1) & 0x1FFFF
    return np.tile(bits, 2)


@dataclass(frozen=True)
class Sender:
    """Rotor and slow bits of a base station. Times are true seconds."""

    channel: int
    zero_s: float = 0.004
    ppm: float = 0.0
    planes: tuple[Callable[[float], float], ...] = (
        lambda time: 0.31 + 0.02 * np.sin(0.9 * time),
        lambda time: 0.63 + 0.02 * np.cos(0.7 * time),
    )
    slow: tuple[int, ...] = (0, 1, 1, 0, 1)
    wander: Callable[[float], float] = lambda time: 0.0
    since_s: float = 0.0
    until_s: float = np.inf


@dataclass(frozen=True)
class Receiving:
    """Imperfections of the receiver and of the recorder."""

    rate_hz: float = 40e6
    clock_ppm: float = 0.0
    resolution_hz: float | None = None
    delay_s: float = 0.0
    """Delay of rising edges plus advance of falling edges."""
    jitter_s: float = 0.0
    lost: float = 0.0
    """Fraction of the short pulses that is lost."""
    rim_s: float = 0.0
    """Duration of noise before and after a burst."""
    missing: float = 0.0
    spoiled: float = 0.0
    """Fractions of the sweeps that are not received, and that are received with random bits."""
    width_s: float = 25e-6


@dataclass
class Passed:
    """Sweeps that crossed photodiodes, ascending in time."""

    time_s: Array
    sensor: NDArray[np.int64]
    channel: NDArray[np.int64]
    polynomial: NDArray[np.int64]
    plane: NDArray[np.int64]
    rotation: NDArray[np.int64]
    count: Array
    spoiled: NDArray[np.bool_]


def biphase(bits: NDArray[np.int8]) -> Array:
    """Return the times of the edges of bits, in bits: between bits, and in the middle of ones."""
    return np.sort(np.concatenate([np.arange(len(bits) + 1), np.flatnonzero(bits) + 0.5]))


def as_received(change_s: Array, path: Receiving, noise: np.random.Generator) -> Array:
    """Return the edges received for changes of light: rising first, as many falling."""
    edge = change_s
    if path.rim_s:
        before, after = (np.cumsum(noise.uniform(5e-8, 4e-7, 40)) for _ in range(2))
        before, after = (side[side < path.rim_s] for side in (before, after))
        edge = np.concatenate([edge[0] - 1e-7 - before[::-1], edge, edge[-1] + 1e-7 + after])
    if len(edge) % 2:
        edge = np.append(edge, edge[-1] + 1.67e-7)
    rising = np.arange(len(edge)) % 2 == 0
    edge = edge + np.where(rising, 0.5, -0.5) * path.delay_s
    edge = edge + noise.normal(0, path.jitter_s, len(edge)) if path.jitter_s else edge
    short = np.flatnonzero(np.diff(edge) < 1.1e-7)
    gone = short[noise.random(len(short)) < path.lost]
    gone = np.concatenate([gone, np.flatnonzero(np.diff(edge) <= 0)])
    keep = np.ones(len(edge), bool)
    for k in np.sort(gone):
        if keep[k] and keep[k + 1]:
            keep[k] = keep[k + 1] = False
    return np.sort(edge[keep])


def light_of(
    senders: Sequence[Sender],
    seconds: float,
    path: Receiving = Receiving(),
    *,
    sensors: int = 1,
    others: Sequence[Array] = (),
    seed: int = 1,
) -> tuple[list[Edges], Passed]:
    """Simulate the edges that photodiodes receive, and the true sweeps.

    ``others`` are edges of other light, in seconds. A sweep crosses the photodiodes 9 us one
    after the other.
    """
    noise = np.random.default_rng(seed)
    rows: list[tuple[float, ...]] = []
    lines: list[list[Array]] = [[np.asarray(each) for each in others] for _ in range(sensors)]
    for sender in senders:
        nominal_s = ROTATION_TICKS[sender.channel] / 48e6
        turn_s = nominal_s * (1 + sender.ppm * 1e-6)
        bit_s = (1 + sender.ppm * 1e-6) / 6e6
        for rotation in range(int((seconds - sender.zero_s) / turn_s) - 1):
            zero = sender.zero_s + rotation * turn_s
            if not sender.since_s <= zero < sender.until_s:
                continue
            zero += sender.wander(zero)
            polynomial = 2 * (sender.channel - 1) + sender.slow[rotation % len(sender.slow)]
            for plane, place in enumerate(sender.planes):
                for sensor in range(sensors):
                    if noise.random() < path.missing:
                        continue
                    middle = place(zero) * turn_s + 9e-6 * sensor
                    first, last = np.rint((middle + path.width_s * np.array([-0.5, 0.5])) / bit_s)
                    bits = sequence(polynomial)[int(first) : int(last)]
                    spoiled = noise.random() < path.spoiled
                    if spoiled:
                        bits = noise.integers(0, 2, len(bits)).astype(np.int8)
                    change = zero + (first + biphase(bits)) * bit_s
                    lines[sensor].append(as_received(change, path, noise))
                    count = (first + last) / 2
                    rows.append(
                        (zero + count * bit_s, sensor, sender.channel, polynomial, plane,
                         rotation, count, spoiled)
                    )  # fmt: skip
    table = np.array(sorted(rows)).reshape(-1, 8)
    passed = Passed(
        table[:, 0],
        *(table[:, k].astype(np.int64) for k in range(1, 6)),
        table[:, 6],
        table[:, 7] > 0,
    )
    return [edges_of(np.concatenate(line), seconds, path) for line in lines], passed


def edges_of(edge_s: Array, seconds: float, path: Receiving = Receiving()) -> Edges:
    """Record edges at true times, the first one rising."""
    resolution = path.resolution_hz or path.rate_hz
    clock = 1 + path.clock_ppm * 1e-6
    tick = np.floor(np.sort(edge_s) * clock * resolution) / resolution * path.rate_hz
    tick = np.rint(tick).astype(np.int64)
    # Two edges within a sample cancel.
    number, times = np.unique(tick, return_counts=True)
    tick = number[times % 2 == 1]
    end = int(max(seconds * path.rate_hz, tick[-1] if len(tick) else 0)) + 1
    return Edges(tick, path.rate_hz, resolution, True, end)


class Light:
    """Namespace of the functions above, for tests, which cannot import a conftest."""

    Sender, Receiving, Passed = Sender, Receiving, Passed
    ticks = ROTATION_TICKS
    sequence = staticmethod(sequence)
    biphase = staticmethod(biphase)
    as_received = staticmethod(as_received)
    of = staticmethod(light_of)
    edges = staticmethod(edges_of)


@pytest.fixture(scope="session")
def light() -> type[Light]:
    """Independent simulation of the light of stations, edge by edge."""
    return Light


@pytest.fixture(scope="session")
def published(recordings: Path) -> Callable[[str], Edges]:
    """Return a published recording of light by its path; each is read once."""
    from locatk.formats.importers.saleae.recording import read_light

    @cache
    def read(name: str) -> Edges:
        path = recordings / name
        if not path.exists():
            pytest.skip(f"{path} is absent")
        (edges,) = read_light(path)
        return edges

    return read
