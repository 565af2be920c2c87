"""Recordings of Lighthouse V2 by libsurvive (``.rec``, ``.rec.gz``), imported as sweeps.

libsurvive (cntools/libsurvive, MIT) drives SteamVR trackers, controllers and headsets, whose
hardware decodes the light: a recording contains each sweep's timecode and the syncs of each
station's rotor (:mod:`~locatk.formats.importers.libsurvive.rec_file`). From them follow

* counts: the rotor angle on the station's own clock, times the nominal period, so that the
  tracker's clock changes no angle (:mod:`~locatk.core.lighthouse.demodulation.tracker_syncs`).
  The offsets - 2 pi / 3 of the first plane and - 4 pi / 3 of the second in libsurvive's angles
  are :data:`~locatk.core.lighthouse.light_planes.ROTOR_ZERO_RAD`, the sign is the same;
* times: the device's counter, mapped to the host's seconds by one line
  (:mod:`~locatk.formats.importers.libsurvive.sweeps`);
* factory data, from the slow bits of the syncs;
* photodiodes, from the device's configuration, and recorded poses, as truth
  (:mod:`~locatk.formats.importers.libsurvive.device`).

Channels are counted from 0 in the file, from 1 in locatk.
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
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.importers.libsurvive.device import (
    read_receiver,
    serial_number,
    station_rotation,
)
from locatk.formats.importers.libsurvive.rec_file import RecFile, read_rec_file
from locatk.formats.importers.libsurvive.sweeps import DeviceSweeps, read_device_sweeps

FRAME = "libsurvive"
EXTERNAL = "libsurvive-external"
"""Frames of recorded poses: libsurvive's world, and that of another tracking system."""

REPLAYED_PREFIX = "replay_"
"""Prefix of a device in poses that an earlier run of libsurvive solved."""

STATION_SIGMA_M, STATION_SIGMA_RAD = 3e-3, 1e-3
"""Standard deviations of the stations that libsurvive solved, from all sweeps of a tracker."""

MIN_QUATERNION_LENGTH = 1e-3
"""Recorded quaternions that are shorter have no direction."""

IMPORTED_KINDS = ("CONFIG", "OPTION", "POSE", "EXTERNAL_POSE", "LH_POSE")


def read_libsurvive(paths: Sequence[Path], *, stations: bool = False) -> ImportedSession:
    """Import one recording as a session.

    Parameters
    ----------
    paths : sequence of path
        One ``.rec`` or ``.rec.gz``: each starts at 0 s of its own.
    stations : bool
        Take the poses of stations that libsurvive solved and recorded (``LH_POSE``, the last of
        each). Otherwise the scene has calibrations only.

    Raises
    ------
    MissingDataError
        No file is given, or it is missing.
    FormatError
        The file is not a recording of libsurvive, or one of Lighthouse V1.
    InputError
        There are several files, or no sweep of a station with a known rotor.
    """
    if not paths:
        raise MissingDataError("no recording to import")
    if len(paths) > 1:
        raise InputError(
            "several recordings, which all start at 0 s",
            hint="Import each into a session of its own",
        )
    path = Path(paths[0])
    recording = read_rec_file(path)
    cut = "" if recording.cut is None else f" ({recording.cut})"
    if not len(recording.sweeps):
        _refuse(recording, path, cut)
    warnings: list[str] = []
    lost: list[str] = [] if recording.cut is None else [recording.cut]
    by_device = [read_device_sweeps(recording, i) for i in range(len(recording.devices))]
    warnings += [warning for each in by_device for warning in each.warnings]
    receivers = _receivers(recording, warnings)
    sweeps = _merge_sweeps(recording, by_device)
    is_unknown = _is_unknown_photodiode(sweeps, receivers)
    is_early = ~is_unknown & (sweeps.time_ns < 0)
    sweeps = _take(sweeps, ~is_unknown & ~is_early)
    if not len(sweeps):
        raise InputError(
            f"no sweep of a station with a known rotor{cut}",
            file=path,
            hint="A recording needs at least four syncs (lines Y) of a station",
        )
    reports = _station_reports(by_device, sweeps, warnings)
    truth = _truth(recording, warnings)
    skipped = [
        (recording.damaged, "damaged line", ""),
        (sum(d.unplaced for d in by_device), "line", " with a timecode that contradicts its time"),
        (sum(d.rotorless for d in by_device), "sweep", " far from any sync"),
        (int(is_early.sum()), "sweep", " before the recording began"),
        (int(is_unknown.sum()), "sweep", " of photodiodes missing in the device's configuration"),
    ]
    lost += [f"{n} {noun}{'s' * (n > 1)}{detail}" for n, noun, detail in skipped if n]
    facts = _facts(recording, path, by_device, sweeps, truth)
    repaired = sum(each.repaired for each in by_device)
    if repaired:
        facts["timecodes"] = f"{repaired} had wrong upper bits, which were corrected by their time"
    return ImportedSession(
        sweeps,
        _scene(recording, reports, stations, warnings),
        truth,
        facts,
        warnings,
        reports,
        receivers,
        ", ".join(lost) or None,
    )


def _refuse(recording: RecFile, path: Path, cut: str) -> None:
    first_generation = sum(recording.kinds[kind] for kind in ("C", "L", "R", "A", "S"))
    if first_generation:
        raise FormatError(
            "a recording of Lighthouse V1",
            file=path,
            hint="Only Lighthouse V2 is supported",
        )
    raise FormatError(
        f"a recording without a sweep (lines W){cut}",
        file=path,
        hint="Record with --record-angle 1 and the stations running",
    )


def _merge_sweeps(recording: RecFile, by_device: list[DeviceSweeps]) -> Sweeps:
    """Return the sweeps of all devices in order of time."""
    lines = np.concatenate([each.row for each in by_device])
    time_ns = np.concatenate([each.time_ns for each in by_device])
    revolution = np.concatenate([each.revolution for each in by_device])
    bit = np.concatenate([each.bit for each in by_device])
    plane = np.concatenate([each.plane for each in by_device])
    order = np.argsort(time_ns, kind="stable")
    columns = recording.sweeps.take(lines[order])
    channel = columns.channel + 1
    return Sweeps(
        recording.devices,
        time_ns[order],
        columns.device,
        columns.sensor,
        channel.astype(np.int32),
        np.where(bit[order] < 0, UNKNOWN, 2 * columns.channel + bit[order]).astype(np.int32),
        plane[order].astype(np.int32),
        revolution[order] * period_counts(channel),
    )


def _station_reports(
    by_device: list[DeviceSweeps], sweeps: Sweeps, warnings: list[str]
) -> tuple[StationReport, ...]:
    """Return the report of each station, from the syncs of all devices."""
    reports = []
    for channel in sorted({channel for each in by_device for channel in each.rotors}):
        rotors = [rotor for each in by_device for rotor in each.rotors.get(channel, ())]
        longest = max(rotors, key=lambda rotor: len(rotor.zero_tick))
        frames = [frame for rotor in rotors for frame in ootx.decode_frames(rotor.slow_bits())]
        data = _factory_data([f.payload for f in frames if f.is_valid], channel + 1, warnings)
        reports.append(
            StationReport(
                channel + 1,
                None if data is None else data.id,
                longest.period_tick,
                int(np.count_nonzero(sweeps.channel == channel + 1)),
                None,
                None if data is None else data.calibration,
                sum(frame.is_valid for frame in frames),
                sum(not frame.is_valid for frame in frames),
                None if data is None else data.acceleration,
            )
        )
    return tuple(reports)


def _factory_data(
    payloads: list[bytes], channel: int, warnings: list[str]
) -> ootx.FactoryData | None:
    """Return the most frequent factory data of a channel."""
    valid: list[ootx.FactoryData] = []
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
        valid.append(data)
    ids = [data.id for data in valid]
    if len(set(ids)) > 1:
        warnings.append(
            f"channel {channel}: factory data of {len(set(ids))} stations; do two share the "
            "channel? The more frequent is used"
        )
    return max(valid, key=lambda data: ids.count(data.id), default=None)


def _scene(
    recording: RecFile,
    reports: tuple[StationReport, ...],
    stations: bool,
    warnings: list[str],
) -> Scene | None:
    """Return calibrations, ids and, if requested, the recorded poses of the stations."""
    calibrations = {s.channel: s.calibration for s in reports if s.calibration is not None}
    ids = {s.channel: s.id for s in reports if s.id is not None}
    posed: list[Station] = []
    for channel, calibration in calibrations.items() if stations else ():
        poses = recording.poses.get(("LH_POSE", str(channel - 1)))
        if poses is None or np.linalg.norm(poses[-1, 4:]) < MIN_QUATERNION_LENGTH:
            warnings.append(f"channel {channel}: the recording has no pose of the station")
            continue
        posed.append(_station(channel, poses[-1], calibration, ids.get(channel)))
    if not posed:
        return Scene(calibrations=calibrations, ids=ids) if calibrations else None
    posed_channels = {station.channel for station in posed}
    return Scene(
        tuple(posed),
        scale="device",
        frame=FRAME,
        notes=("stations as libsurvive solved them (LH_POSE)",),
        frame_source="gravity",  # The IMU of the tracker levels libsurvive's world.
        calibrations={c: value for c, value in calibrations.items() if c not in posed_channels},
        ids={c: value for c, value in ids.items() if c not in posed_channels},
    )


def _station(
    channel: int, pose: NDArray[np.float64], calibration: Calibration, number: int | None
) -> Station:
    covariance = np.diag(np.repeat([STATION_SIGMA_M, STATION_SIGMA_RAD], 3) ** 2)
    return Station(channel, pose[1:4], station_rotation(pose[4:]), calibration, number, covariance)


def _in_imu(recording: RecFile) -> bool:
    """Return whether poses are of the imu, not of the head."""
    return recording.options.get("report-in-imu", "0") not in ("0", "")


def _receivers(recording: RecFile, warnings: list[str]) -> dict[str, Receiver]:
    """Return the photodiodes of the devices with a valid configuration."""
    in_imu = _in_imu(recording)
    receivers: dict[str, Receiver] = {}
    for name in recording.devices:
        config = recording.configs.get(name)
        if config is None:
            warnings.append(f"the recording has no configuration of {name}")
            continue
        try:
            receiver = read_receiver(config, in_imu)
            loads_receiver(dumps_receiver(receiver))
        except (FormatError, ArtifactError) as error:
            warnings.append(f"{name}: {error.message}; its photodiodes are not imported")
            continue
        receivers[name] = receiver
    return receivers


def _is_unknown_photodiode(sweeps: Sweeps, receivers: dict[str, Receiver]) -> NDArray[np.bool_]:
    """Return the sweeps (n,) of photodiodes that are not among those of the device."""
    limit = np.iinfo(np.int32).max
    count = np.array([len(receivers[d]) if d in receivers else limit for d in sweeps.devices])
    return np.asarray(sweeps.sensor >= count[sweeps.device])


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


def _truth(recording: RecFile, warnings: list[str]) -> list[Trajectory]:
    """Return recorded poses of each device: of another system or run, else libsurvive's own."""
    truth = []
    for name in recording.devices:
        config = recording.configs.get(name)
        serial = serial_number(config) if config is not None else ""
        sources = [
            ("EXTERNAL_POSE", REPLAYED_PREFIX + name, FRAME),
            ("EXTERNAL_POSE", name, EXTERNAL),
            ("EXTERNAL_POSE", serial, EXTERNAL),
            ("POSE", name, FRAME),
        ]
        for kind, pose_name, frame in sources:
            poses = recording.poses.get((kind, pose_name))
            if poses is not None:
                truth.append(_trajectory(name, frame, poses, warnings))
                break
    return [trajectory for trajectory in truth if len(trajectory)]


def _trajectory(
    name: str, frame: str, poses: NDArray[np.float64], warnings: list[str]
) -> Trajectory:
    time_ns = np.rint(poses[:, 0] * 1e9).astype(np.int64)
    length = np.linalg.norm(poses[:, 4:], axis=1)
    valid = np.flatnonzero(length > MIN_QUATERNION_LENGTH)
    if len(valid) < len(poses):
        warnings.append(f"{len(poses) - len(valid)} recorded poses of {name} have no direction")
    # Of poses with the same time, the last is kept.
    kept = valid[::-1][np.unique(time_ns[valid][::-1], return_index=True)[1]]
    if len(kept) < len(valid):
        warnings.append(f"{len(valid) - len(kept)} recorded poses of {name} repeat a stamp")
    return Trajectory(
        name,
        frame,
        time_ns[kept],
        poses[kept, 1:4],
        np.roll(poses[kept, 4:], -1, axis=1) / length[kept, None],
        np.full((len(kept), 6, 6), np.nan),
    )


def _facts(
    recording: RecFile,
    path: Path,
    by_device: list[DeviceSweeps],
    sweeps: Sweeps,
    truth: list[Trajectory],
) -> dict[str, str]:
    count = np.bincount(sweeps.device, minlength=len(recording.devices))
    skipped = {kind: n for kind, n in recording.kinds.most_common() if kind not in IMPORTED_KINDS}
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
            f"{name} runs {each.ppm:+.1f} ppm fast by the host's clock, its lines "
            f"are {each.lag_s * 1e3:.1f} ms late"
            for name, each in zip(recording.devices, by_device, strict=True)
        ),
    }
    if truth:
        facts["truth"] = ", ".join(f"{len(t)} poses of {t.device} ({t.frame})" for t in truth)
        facts["axes"] = f"those of the device's {'imu' if _in_imu(recording) else 'head'}"
    if skipped:
        facts["skipped"] = ", ".join(f"{n} {kind}" for kind, n in skipped.items())
    return facts
