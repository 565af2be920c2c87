"""libsurvive's recordings of Lighthouse V2 (``.rec``, ``.rec.gz``), read into sweeps.

libsurvive (cntools/libsurvive, MIT) drives SteamVR trackers, controllers and headsets, whose
hardware decodes the light: a recording holds each sweep's timecode and the syncs of each
station's rotor (:mod:`~locatk.formats.importers.libsurvive.lines`). From them come

* counts: the turn since the rotor's zero on the station's own clock, times the nominal
  rotation, so that the tracker's clock bends no angle
  (:mod:`~locatk.core.lighthouse.demodulation.tracker_syncs`). The angle is libsurvive's:
  2 pi turn - 2 pi / 3 of the first plane and - 4 pi / 3 of the second are
  :data:`~locatk.core.lighthouse.light_planes.ROTOR_ZERO_RAD`, the sign is the same;
* times: of the device's counter, mapped on the host's seconds by one line
  (:mod:`~locatk.formats.importers.libsurvive.clock`);
* factory data, from the slow bits of the syncs;
* photodiodes, from the device's configuration, and recorded poses, as truth
  (:mod:`~locatk.formats.importers.libsurvive.device`).

Channels of the file are counted from 0, here from 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import ArtifactError, FormatError, InputError, MissingDataError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.demodulation import ootx
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import UNKNOWN, StationReport, Sweeps
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts.receiver import dumps_receiver, loads_receiver
from locatk.formats.importers.libsurvive.device import (
    read_receiver,
    serial_number,
    station_rotation,
)
from locatk.formats.importers.libsurvive.lines import Recording, read_lines
from locatk.formats.importers.libsurvive.sweeps import HeardSweeps, hear
from locatk.formats.importers.lighthouse import ImportedSession

FRAME = "libsurvive"
EXTERNAL = "libsurvive-external"
"""Frames of recorded poses: libsurvive's world, and that of another tracking system."""

REPLAYED = "replay_"
"""Before the name of a device whose poses an earlier run of libsurvive has solved."""

_READ = ("CONFIG", "OPTION", "POSE", "EXTERNAL_POSE", "LH_POSE")


def read_libsurvive(paths: Sequence[Path], *, stations: bool = False) -> ImportedSession:
    """Read one recording.

    Parameters
    ----------
    paths : sequence of path
        One ``.rec`` or ``.rec.gz``: each starts at 0 s of its own.
    stations : bool
        Whether the scene gets the poses of stations that libsurvive solved and recorded
        (``LH_POSE``, the last of each). Otherwise it has calibrations only.

    Raises
    ------
    MissingDataError
        No file is given, or it is not there.
    FormatError
        It is no recording of libsurvive, or one of Lighthouse V1.
    InputError
        Several files, or no sweep of a station whose rotor is known.
    """
    if not paths:
        raise MissingDataError("no recording to import")
    if len(paths) > 1:
        raise InputError(
            "several recordings, which all start at 0 s",
            hint="import each into a session of its own",
        )
    path = Path(paths[0])
    recording = read_lines(path)
    cut = "" if recording.cut is None else f" ({recording.cut})"
    if not len(recording.sweeps):
        _refuse(recording, path, cut)
    warnings: list[str] = []
    lost: list[str] = [] if recording.cut is None else [recording.cut]
    heard = [hear(recording, i) for i in range(len(recording.devices))]
    warnings += [warning for h in heard for warning in h.warnings]
    receivers = _receivers(recording, warnings)
    sweeps = _sweeps(recording, heard)
    strange = _not_on_device(sweeps, receivers)
    before = ~strange & (sweeps.time_ns < 0)
    sweeps = _take(sweeps, ~strange & ~before)
    if not len(sweeps):
        raise InputError(
            f"no sweep of a station whose rotor is known{cut}",
            file=path,
            hint="a recording needs at least four syncs (lines Y) of a station",
        )
    told = _stations(heard, sweeps, warnings)
    truth = _truth(recording, warnings)
    left = [
        (recording.damaged, "damaged line", ""),
        (sum(h.unplaced for h in heard), "line", " with a timecode that does not fit its time"),
        (sum(h.rotorless for h in heard), "sweep", " without a sync near"),
        (int(before.sum()), "sweep", " before the recording began"),
        (int(strange.sum()), "sweep", " of photodiodes that the device's configuration lacks"),
    ]
    lost += [f"{n} {what}{'s' * (n > 1)}{which}" for n, what, which in left if n]
    facts = _facts(recording, path, heard, sweeps, truth)
    repaired = sum(h.repaired for h in heard)
    if repaired:
        facts["timecodes"] = f"{repaired} had wrong upper bits, as their time tells: put right"
    return ImportedSession(
        sweeps,
        _scene(recording, told, stations, warnings),
        truth,
        facts,
        warnings,
        told,
        receivers,
        ", ".join(lost) or None,
    )


def _refuse(recording: Recording, path: Path, cut: str) -> None:
    first_generation = sum(recording.kinds[kind] for kind in ("C", "L", "R", "A", "S"))
    if first_generation:
        raise FormatError(
            "a recording of Lighthouse V1, whose stations flash",
            file=path,
            hint="only Lighthouse V2 is read",
        )
    raise FormatError(
        f"a recording without a sweep (lines W){cut}",
        file=path,
        hint="record with --record-angle 1 and the stations running",
    )


def _sweeps(recording: Recording, heard: list[HeardSweeps]) -> Sweeps:
    """All devices' sweeps in order of time."""
    lines = np.concatenate([h.row for h in heard])
    time = np.concatenate([h.time_ns for h in heard])
    turn = np.concatenate([h.turn for h in heard])
    bit = np.concatenate([h.bit for h in heard])
    plane = np.concatenate([h.plane for h in heard])
    order = np.argsort(time, kind="stable")
    columns = recording.sweeps.take(lines[order])
    channel = columns.channel + 1
    return Sweeps(
        recording.devices,
        time[order],
        columns.device,
        columns.sensor,
        channel.astype(np.int32),
        np.where(bit[order] < 0, UNKNOWN, 2 * columns.channel + bit[order]).astype(np.int32),
        plane[order].astype(np.int32),
        turn[order] * period_counts(channel),
    )


def _stations(
    heard: list[HeardSweeps], sweeps: Sweeps, warnings: list[str]
) -> tuple[StationReport, ...]:
    """What all devices together heard of each station."""
    told = []
    for channel in sorted({channel for h in heard for channel in h.rotors}):
        rotors = [rotor for h in heard for rotor in h.rotors.get(channel, ())]
        longest = max(rotors, key=lambda rotor: len(rotor.zero_tick))
        frames = [frame for rotor in rotors for frame in ootx.decode_frames(rotor.slow_bits())]
        data = _factory_data([f.payload for f in frames if f.is_valid], channel + 1, warnings)
        told.append(
            StationReport(
                channel + 1,
                None if data is None else data.id,
                longest.period_tick,
                int(np.count_nonzero(sweeps.channel == channel + 1)),
                None,
                None if data is None else data.calibration,
                sum(frame.is_valid for frame in frames),
                sum(not frame.is_valid for frame in frames),
            )
        )
    return tuple(told)


def _factory_data(
    payloads: list[bytes], channel: int, warnings: list[str]
) -> ootx.FactoryData | None:
    """What most right frames of a channel say."""
    read: list[ootx.FactoryData] = []
    for payload in payloads:
        try:
            data = ootx.decode_factory_data(payload)
        except InputError as error:
            warnings.append(f"channel {channel}: {error.message}")
            continue
        if data.channel != channel:
            warnings.append(
                f"channel {channel}: factory data of station {data.id:08x} is of channel "
                f"{data.channel}; it is not used"
            )
            continue
        read.append(data)
    names = [data.id for data in read]
    if len(set(names)) > 1:
        warnings.append(
            f"channel {channel}: factory data of {len(set(names))} stations; are two on one "
            "channel? The more frequent is used"
        )
    return max(read, key=lambda data: names.count(data.id), default=None)


def _scene(
    recording: Recording,
    told: tuple[StationReport, ...],
    stations: bool,
    warnings: list[str],
) -> Scene | None:
    """Calibrations and ids and, where asked for, the stations' recorded poses."""
    calibrations = {s.channel: s.calibration for s in told if s.calibration is not None}
    ids = {s.channel: s.id for s in told if s.id is not None}
    placed: list[Station] = []
    for channel, calibration in calibrations.items() if stations else ():
        poses = recording.poses.get(("LH_POSE", str(channel - 1)))
        if poses is None or np.linalg.norm(poses[-1, 4:]) < 1e-3:
            warnings.append(f"channel {channel}: the recording has no pose of the station")
            continue
        placed.append(_station(channel, poses[-1], calibration, ids.get(channel)))
    if not placed:
        return Scene(calibrations=calibrations, ids=ids) if calibrations else None
    done = {station.channel for station in placed}
    return Scene(
        tuple(placed),
        scale="device",
        frame=FRAME,
        notes=("stations as libsurvive solved them (LH_POSE)",),
        calibrations={c: value for c, value in calibrations.items() if c not in done},
        ids={c: value for c, value in ids.items() if c not in done},
    )


def _station(
    channel: int, pose: NDArray[np.float64], calibration: Calibration, number: int | None
) -> Station:
    return Station(channel, pose[1:4], station_rotation(pose[4:]), calibration, number)


def _in_imu(recording: Recording) -> bool:
    """Whether poses are of the imu, not of the head."""
    return recording.options.get("report-in-imu", "0") not in ("0", "")


def _receivers(recording: Recording, warnings: list[str]) -> dict[str, Receiver]:
    """Photodiodes of the devices that tell of them."""
    in_imu = _in_imu(recording)
    found: dict[str, Receiver] = {}
    for name in recording.devices:
        config = recording.configs.get(name)
        if config is None:
            warnings.append(f"the recording has no configuration of {name}")
            continue
        try:
            receiver = read_receiver(config, in_imu)
            loads_receiver(dumps_receiver(receiver))
        except (FormatError, ArtifactError) as error:
            warnings.append(f"{name}: {error.message}: where its photodiodes sit is not taken")
            continue
        found[name] = receiver
    return found


def _not_on_device(sweeps: Sweeps, receivers: dict[str, Receiver]) -> NDArray[np.bool_]:
    """Sweeps of photodiodes that are not among those of the device."""
    most = np.array([len(receivers[d]) if d in receivers else 1 << 16 for d in sweeps.devices])
    return np.asarray(sweeps.sensor >= most[sweeps.device])


def _take(sweeps: Sweeps, chosen: NDArray[np.bool_]) -> Sweeps:
    return Sweeps(
        sweeps.devices,
        sweeps.time_ns[chosen],
        sweeps.device[chosen],
        sweeps.sensor[chosen],
        sweeps.channel[chosen],
        sweeps.polynomial[chosen],
        sweeps.sweep[chosen],
        sweeps.count[chosen],
    )


def _truth(recording: Recording, warnings: list[str]) -> list[Trajectory]:
    """Recorded poses of each device: of another system or run, else libsurvive's own."""
    found = []
    for name in recording.devices:
        config = recording.configs.get(name)
        serial = serial_number(config) if config is not None else ""
        sources = [
            ("EXTERNAL_POSE", REPLAYED + name, FRAME),
            ("EXTERNAL_POSE", name, EXTERNAL),
            ("EXTERNAL_POSE", serial, EXTERNAL),
            ("POSE", name, FRAME),
        ]
        for kind, called, frame in sources:
            poses = recording.poses.get((kind, called))
            if poses is not None:
                found.append(_trajectory(name, frame, poses, warnings))
                break
    return [trajectory for trajectory in found if len(trajectory)]


def _trajectory(
    name: str, frame: str, poses: NDArray[np.float64], warnings: list[str]
) -> Trajectory:
    time = np.rint(poses[:, 0] * 1e9).astype(np.int64)
    length = np.linalg.norm(poses[:, 4:], axis=1)
    good = np.flatnonzero(length > 1e-3)
    if len(good) < len(poses):
        warnings.append(f"{len(poses) - len(good)} recorded poses of {name} have no direction")
    # The last of those with one stamp.
    kept = good[::-1][np.unique(time[good][::-1], return_index=True)[1]]
    if len(kept) < len(good):
        warnings.append(f"{len(good) - len(kept)} recorded poses of {name} repeat a stamp")
    return Trajectory(
        name,
        frame,
        time[kept],
        poses[kept, 1:4],
        np.roll(poses[kept, 4:], -1, axis=1) / length[kept, None],
        np.full((len(kept), 6, 6), np.nan),
    )


def _facts(
    recording: Recording,
    path: Path,
    heard: list[HeardSweeps],
    sweeps: Sweeps,
    truth: list[Trajectory],
) -> dict[str, str]:
    count = np.bincount(sweeps.device, minlength=len(recording.devices))
    skipped = {kind: n for kind, n in recording.kinds.most_common() if kind not in _READ}
    facts = {
        "format": "libsurvive",
        "files": path.name,
        "sweeps": str(len(sweeps)),
        "devices": ", ".join(
            f"{name} ({n} sweeps)" for name, n in zip(recording.devices, count, strict=True)
        ),
        "channels": ", ".join(map(str, np.unique(sweeps.channel))),
        "clock": "seconds since the recording began, as nanoseconds since the epoch; "
        + ", ".join(
            f"{name} runs {h.ppm:+.1f} ppm fast by the host's clock, its lines "
            f"are {h.lag_s * 1e3:.1f} ms late"
            for name, h in zip(recording.devices, heard, strict=True)
        ),
    }
    if truth:
        facts["truth"] = ", ".join(f"{len(t)} poses of {t.device} ({t.frame})" for t in truth)
        facts["axes"] = f"of a device are those of its {'imu' if _in_imu(recording) else 'head'}"
    if skipped:
        facts["skipped"] = ", ".join(f"{n} {kind}" for kind, n in skipped.items())
    return facts
