"""A simulated flight of a Crazyflie and a writer of its logs, independent of the package.

The rotor model, the light planes and the file format are implemented here a second time, from
Bitcraze's documents: kalman_measurement_model.md (planes), lighthouse-fpga's readme (frames of the
deck), pulse_processor_v2.c (angles), usddeck.c and cfusdlog.py (file).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SENSORS = np.array([[-15, 7.5, 0], [-15, -7.5, 0], [15, 7.5, 0], [15, -7.5, 0]]) * 1e-3
ROTOR_HZ = {1: 48e6 / 959000, 2: 48e6 / 957000, 3: 48e6 / 953000}
HZ = 24_000_000


@dataclass
class FlightStation:
    """Station with tilted and shifted planes, without the other errors of real ones."""

    channel: int
    position: Array
    rotation: Array
    tilt: tuple[float, float] = (-0.049, 0.046)
    phase: tuple[float, float] = (0.0, -0.005)
    zero_s: float = 0.003
    ppm: float = 8.0

    def angle(self, plane: int, point: Array) -> Array:
        """Rotor angle at which a plane crosses points (n, 3) of the room; 0 straight ahead."""
        x, y, z = ((point - self.position) @ self.rotation).T
        tilt = (np.pi / 6, -np.pi / 6)[plane] + self.tilt[plane]
        return np.arctan2(y, x) - np.arcsin(z * np.tan(tilt) / np.hypot(x, y)) - self.phase[plane]


def look_at(position: Array, target: Array) -> Array:
    x = (target - position) / np.linalg.norm(target - position)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def stations(count: int = 2) -> list[FlightStation]:
    places = np.array([[-2.0, -1.6, 2.2], [2.1, 1.5, 2.1], [-1.9, 1.8, 2.3]])[:count]
    target = np.array([0.0, 0.0, 0.6])
    return [
        FlightStation(k + 1, p, look_at(p, target), zero_s=0.003 + 0.0041 * k, ppm=8.0 - 11 * k)
        for k, p in enumerate(places)
    ]


@dataclass
class Flight:
    """Smooth path with known attitude: position and rotation are functions of time."""

    seconds: float = 20.0
    speed: float = 1.0
    stations: list[FlightStation] = field(default_factory=stations)

    def position(self, t: Array) -> Array:
        w = self.speed
        return np.column_stack(
            [0.7 * np.sin(0.9 * w * t), 0.6 * np.cos(0.7 * w * t), 0.7 + 0.3 * np.sin(0.5 * w * t)]
        )

    def rotation(self, t: Array) -> Array:
        """(n, 3, 3) body to room: yaw, then pitch (nose down positive), then roll."""
        w = self.speed
        yaw, pitch, roll = self.angles(t)
        return rotations(yaw, pitch, roll) if w else rotations(0 * t, 0 * t, 0 * t)

    def angles(self, t: Array) -> tuple[Array, Array, Array]:
        """Yaw, pitch (positive with the nose down) and roll [rad]."""
        w = self.speed
        return 0.8 * np.sin(0.4 * w * t), 0.12 * np.sin(1.1 * w * t), 0.1 * np.cos(1.3 * w * t)

    def sensor(self, number: Array, t: Array) -> Array:
        return self.position(t) + np.einsum("nij,nj->ni", self.rotation(t), SENSORS[number])

    def acceleration(self, t: Array) -> Array:
        """Specific force in body axes [m/s^2]."""
        h = 1e-3
        second = self.position(t + h) - 2 * self.position(t) + self.position(t - h)
        force = second / h**2 + [0.0, 0.0, 9.80665]
        return np.einsum("nji,nj->ni", self.rotation(t), force)

    def angular_rate(self, t: Array) -> Array:
        """About the body's axes [rad/s]."""
        h = 1e-4
        step = np.einsum("nji,njk->nik", self.rotation(t - h), self.rotation(t + h)) / (2 * h)
        return np.column_stack([step[:, 2, 1], step[:, 0, 2], step[:, 1, 0]])

    def crossings(self) -> dict[str, Array]:
        """Times at which the planes cross the photodiodes."""
        parts = []
        for station in self.stations:
            period = 1 / ROTOR_HZ[station.channel] * (1 + station.ppm * 1e-6)
            turns = np.arange(int((self.seconds - station.zero_s) / period) - 1)
            zero = station.zero_s + turns * period
            for plane in (0, 1):
                for number in range(4):
                    t = zero + period / 2
                    sensor = np.full(len(t), number)
                    for _ in range(6):
                        angle = station.angle(plane, self.sensor(sensor, t))
                        fraction = (angle + (2, 4)[plane] * np.pi / 3) / (2 * np.pi)
                        t = zero + period * fraction
                    local = (self.sensor(sensor, t) - station.position) @ station.rotation
                    azimuth = np.abs(np.arctan2(local[:, 1], local[:, 0]))
                    seen = azimuth < np.deg2rad(75)
                    n = int(seen.sum())
                    parts.append(
                        {
                            "t": t[seen], "fraction": fraction[seen], "turn": turns[seen],
                            "channel": np.full(n, station.channel), "plane": np.full(n, plane),
                            "sensor": np.full(n, number), "zero": zero[seen],
                        }
                    )  # fmt: skip
        columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        order = np.argsort(columns["t"], kind="stable")
        return {key: values[order] for key, values in columns.items()}


def rotations(yaw: Array, pitch: Array, roll: Array) -> Array:
    def turn(axis: int, angle: Array) -> Array:
        matrix = np.zeros((len(angle), 3, 3))
        i, j = (axis + 1) % 3, (axis + 2) % 3
        matrix[:, axis, axis] = 1
        matrix[:, i, i] = matrix[:, j, j] = np.cos(angle)
        matrix[:, j, i], matrix[:, i, j] = np.sin(angle), -np.sin(angle)
        return matrix

    return turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)


# ---- the deck


def deck_frames(
    flight: Flight,
    rng: np.random.Generator,
    *,
    lost: float = 0.02,
    unknown: float = 0.3,
    jitter_ticks: float = 1.5,
    wrong_offset: float = 1e-3,
) -> dict[str, NDArray[np.int64]]:
    """Frames of the deck with their truth (``plane``, ``true_channel``, ``fraction``).

    As in a deck, the first pulse of a group has no channel, and one of the others the offset, in
    steps of 6 MHz. Some pulses are lost, some more have no channel, and some offsets are wrong.
    """
    truth = flight.crossings()
    keep = rng.random(len(truth["t"])) >= lost
    # Occlusion hides whole passages.
    passage = np.round(truth["t"] * 300).astype(int)
    hidden = rng.random(passage.max() + 1) < 0.05
    keep &= ~hidden[passage]
    truth = {key: values[keep] for key, values in truth.items()}
    n = len(truth["t"])
    tick = np.rint(truth["t"] * HZ + rng.normal(0, jitter_ticks, n)).astype(np.int64)
    group = np.cumsum(np.diff(tick, prepend=tick[0]) > 10_000)
    first = np.diff(group, prepend=-1) > 0
    known = ~first & (rng.random(n) >= unknown)
    # The station counts by its own clock, which drives its rotor too.
    nominal = 6e6 / np.array([np.inf, *ROTOR_HZ.values()])[truth["channel"]]
    count = np.rint(truth["fraction"] * nominal).astype(np.int64)
    offset = np.zeros(n, np.int64)
    for channel in ROTOR_HZ:
        mine = np.flatnonzero(known & (truth["channel"] == channel))
        chosen = mine[np.unique(group[mine], return_index=True)[1]]
        offset[chosen] = 4 * count[chosen]
    spoilt = (offset > 0) & (rng.random(n) < wrong_offset)
    offset[spoilt] = 4 * rng.integers(1, 1 << 17, spoilt.sum())
    return {
        "tick": tick, "sensor": truth["sensor"], "offset": offset,
        "channel": np.where(known, truth["channel"], -1),
        "true_channel": truth["channel"], "plane": truth["plane"],
        "fraction": truth["fraction"], "t": truth["t"],
    }  # fmt: skip


def firmware_angles(flight: Flight) -> list[tuple[float, int, int, int, float, float]]:
    """(time of the event, sensor, station from 0, sweep, angle, time of the light).

    Only complete rotations have angles.

    They are complete when the next pulse arrives that is 10,000 ticks later.
    """
    truth = flight.crossings()
    tick = np.rint(truth["t"] * HZ).astype(np.int64)
    starts = np.append(np.flatnonzero(np.diff(tick, prepend=-20_000) > 10_000), len(tick))
    rows = []
    for channel in np.unique(truth["channel"]):
        for turn in np.unique(truth["turn"][truth["channel"] == channel]):
            mine = np.flatnonzero((truth["channel"] == channel) & (truth["turn"] == turn))
            if len(mine) < 8:
                continue
            after = starts[np.searchsorted(starts, mine[-1], side="right") :]
            if not len(after) or after[0] == len(tick):
                continue
            time = truth["t"][after[0]]
            for row in mine[np.lexsort((truth["plane"][mine], truth["sensor"][mine]))]:
                plane = int(truth["plane"][row])
                zero = (2, 4)[plane] * np.pi / 3
                count = np.rint(truth["fraction"][row] * 6e6 / ROTOR_HZ[int(channel)])
                angle = 2 * np.pi * count / 6e6 * ROTOR_HZ[int(channel)] - zero
                light = float(truth["t"][row])
                rows.append(
                    (time, int(truth["sensor"][row]), int(channel) - 1, plane, angle, light)
                )
    return sorted(rows, key=lambda row: row[0])


# ---- files


@dataclass
class UsdWriter:
    """Writer of the log format."""

    version: int = 2
    types: dict[int, tuple[str, list[tuple[str, str]]]] = field(default_factory=dict)
    events: list[tuple[float, int, tuple[float, ...]]] = field(default_factory=list)

    def event_type(self, number: int, name: str, variables: str) -> None:
        pairs = [tuple(each.split(":")) for each in variables.split()]
        self.types[number] = (name, [(pair[0], pair[1]) for pair in pairs])

    def add(self, time_s: float, number: int, *values: float) -> None:
        self.events.append((time_s, number, values))

    def header(self) -> bytes:
        data = struct.pack("<BHH", 0xBC, self.version, len(self.types))
        for number, (name, variables) in self.types.items():
            data += struct.pack("<H", number) + name.encode() + b"\0"
            data += struct.pack("<H", len(variables))
            data += b"".join(f"{v}({t})".encode() + b"\0" for v, t in variables)
        return data

    def data(self, *, crc: bool = True, in_order: bool = True) -> bytes:
        parts = [self.header()]
        events = sorted(self.events, key=lambda e: e[0]) if in_order else self.events
        for time_s, number, values in events:
            letters = "".join(t for _, t in self.types[number][1])
            stamp = int(time_s * (1e3 if self.version == 1 else 1e6))
            code = "<HI" if self.version == 1 else "<HQ"
            parts.append(struct.pack(code, number, stamp) + struct.pack("<" + letters, *values))
        data = b"".join(parts)
        return data + struct.pack("<I", zlib.crc32(data)) if crc else data


def write_flight(
    flight: Flight,
    rng: np.random.Generator,
    *,
    version: int = 2,
    rate: float = 84 / 85,
    start_s: float = 31.7,
    frames: bool = True,
    angles: bool = False,
    estimator: bool = False,
    unknown_station: int = 4,
    imu_hz: float = 100.0,
    quaternion: bool = True,
    **deck: float,
) -> UsdWriter:
    """Log of a flight. The Crazyflie's clock starts ``start_s`` before it and runs at ``rate``."""
    log = UsdWriter(version)
    state = "stateEstimate."
    attitude = ("qx:f qy:f qz:f qw:f" if quaternion else "roll:f pitch:f yaw:f").split()
    names = "acc.x:f acc.y:f acc.z:f gyro.x:f gyro.y:f gyro.z:f range.zrange:H"
    names += "".join(f" {state}{name}" for name in ["x:f", "y:f", "z:f", *attitude])
    log.event_type(65535, "fixedFrequency", names)
    log.event_type(3, "estTDOA", "idA:B idB:B distanceDiff:f")
    log.event_type(
        11, "lhUartFrame",
        "sensor:B basestation:B offset:I timestampFPGA:I timestamp2FPGA:I pm.vbat:f",
    )  # fmt: skip
    log.event_type(12, "lhAngle", "sensor:B basestation:B sweep:B angle:f correctedAngle:f")
    log.event_type(7, "estSweepAngle", "sensorId:B baseStationId:B sweepId:B t:f sweepAngle:f")

    def stamp(time_s: Array | float) -> Array:
        return start_s + rate * np.asarray(time_s)

    t = np.arange(0.0, flight.seconds, 1 / imu_hz)
    force, spin = flight.acceleration(t) / 9.80665, np.rad2deg(flight.angular_rate(t))
    position = flight.position(t)
    yaw, pitch, roll = np.rad2deg(flight.angles(t) if flight.speed else np.zeros((3, len(t))))
    quaternions = to_quaternion(flight.rotation(t))
    for k, time_s in enumerate(stamp(t)):
        orientation = quaternions[k] if quaternion else (roll[k], -pitch[k], yaw[k])
        height = round(1000 * position[k, 2])
        log.add(time_s, 65535, *force[k], *spin[k], height, *position[k], *orientation)
    counter = 0xFFF00000  # wraps during the flight
    if frames:
        pulses = deck_frames(flight, rng, **deck)
        late = 0.00055 + rng.exponential(0.0008, len(pulses["tick"]))
        for k, time_s in enumerate(stamp(pulses["t"] + late)):
            tick = int(pulses["tick"][k]) + counter
            station = pulses["channel"][k] - 1 if pulses["channel"][k] > 0 else unknown_station
            log.add(
                time_s, 11, pulses["sensor"][k], station, pulses["offset"][k],
                tick & 0xFFFFFF, tick & 0xFFFFFFFF, 3.9,
            )  # fmt: skip
    if angles or estimator:
        for time_s, sensor, station, sweep, angle, _ in firmware_angles(flight):
            at = float(stamp(time_s + 0.0006))
            if angles:
                log.add(at, 12, sensor, station, sweep, angle, angle + 0.01)
            if estimator and rng.random() < 0.9:
                tilt = (-1, 1)[sweep] * np.pi / 6
                log.add(at, 7, sensor, station, sweep, tilt, angle)
    return log


def to_quaternion(matrix: Array) -> Array:
    """Quaternions x y z w of rotations by less than 180 degrees."""
    w = np.sqrt(1 + np.trace(matrix, axis1=1, axis2=2)) / 2
    x = (matrix[:, 2, 1] - matrix[:, 1, 2]) / (4 * w)
    y = (matrix[:, 0, 2] - matrix[:, 2, 0]) / (4 * w)
    z = (matrix[:, 1, 0] - matrix[:, 0, 1]) / (4 * w)
    return np.column_stack([x, y, z, w])


def system_config(stations: list[FlightStation]) -> dict[str, object]:
    """Content of the YAML file of cfclient."""
    names = ("curve", "gibmag", "gibphase", "ogeemag", "ogeephase")
    geometries = {
        station.channel - 1: {
            "origin": station.position.tolist(),
            "rotation": station.rotation.tolist(),
        }
        for station in stations
    }
    calibrations = {
        station.channel - 1: {
            "uid": 1000 + station.channel,
            "sweeps": [
                {
                    "phase": station.phase[plane],
                    "tilt": station.tilt[plane],
                    **dict.fromkeys(names, 0.0),
                }
                for plane in (0, 1)
            ],
        }
        for station in stations
    }
    return {
        "type": "lighthouse_system_configuration", "version": "1", "systemType": 2,
        "geos": geometries, "calibs": calibrations,
    }  # fmt: skip
