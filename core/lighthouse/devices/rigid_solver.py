"""Full poses of rigid devices with several photodiodes of known place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.channels import CHANNELS
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps, select_device_sweeps
from locatk.core.lighthouse.devices.scene_initialization import solve_scene
from locatk.core.lighthouse.devices.tracking import TrackedDevice, track_device
from locatk.core.lighthouse.noise import CALIBRATION_SIGMA_RAD
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.robust import robust_sigma
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

BEHIND = 0.3
"""Share of sweeps from behind their photodiodes that calls for a word."""


@dataclass
class DeviceSolution:
    """What :func:`solve_rigid_devices` found.

    Attributes
    ----------
    trajectories : tuple of Trajectory
        One a device with a receiver, in the order of ``sweeps.devices``.
    scene : Scene
        With stations: the given one, or that solved from the devices.
    rejected : dict of str to int
        Reason to number of sweeps (``sweep_...``, ``plane_unknown``, ...) or of moments
        (``moment_...``, ``pose_...``) left out.
    facts : dict
        For the record; angles in radians.
    notes : list of str
        What the user should know.
    residuals : dict of int to (n,) ndarray
        By channel, predicted minus observed angle of the sweeps of the devices.
    used, unused : dict of int to int
        By channel, sweeps that poses stand on, and the others.
    row, residual : (n,) ndarray
        Rows of the sweeps that were looked at, and the residual of each; ``nan`` where it
        was in no pose.
    """

    trajectories: tuple[Trajectory, ...]
    scene: Scene
    rejected: dict[str, int] = field(default_factory=dict)
    facts: dict[str, object] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    residuals: dict[int, Array] = field(default_factory=dict)
    used: dict[int, int] = field(default_factory=dict)
    unused: dict[int, int] = field(default_factory=dict)
    row: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    residual: Array = field(default_factory=lambda: np.zeros(0))


def solve_rigid_devices(
    sweeps: Sweeps,
    receivers: Mapping[str, Receiver],
    scene: Scene | None = None,
    *,
    every_s: float | None = None,
) -> DeviceSolution:
    """Poses of all devices whose photodiodes have known places.

    Parameters
    ----------
    sweeps : Sweeps
        Those of devices without a receiver are not looked at.
    receivers : mapping of str to Receiver
        By device.
    scene : Scene, optional
        With stations: they are used as they are. Without: they are solved from the devices,
        in the axes of the first station, with the scene's calibrations where it has them;
        the scale comes from the devices.
    every_s : float, optional
        Time from pose to pose in seconds; without it, a rotation of the fastest station.

    Raises
    ------
    DegenerateError
        No device with a receiver has a sweep, the scene has none of the recording's
        stations, or no station sees enough of a device to solve the scene.
    """
    scene = scene or Scene()
    chosen = [(i, name) for i, name in enumerate(sweeps.devices) if name in receivers]
    mine = np.isin(sweeps.device, [i for i, _ in chosen])
    heard = [int(c) for c in np.unique(sweeps.channel[mine]) if c in CHANNELS]
    if not heard:
        raise DegenerateError(
            "no device with known photodiodes has a usable sweep",
            hint="receivers are of "
            + (", ".join(receivers) or "no device")
            + "; the recording has "
            + (", ".join(sweeps.devices) or "none"),
        )
    answer = DeviceSolution((), scene)
    if not scene.stations:
        taken = [select_device_sweeps(sweeps, i, receivers[name], heard)[0] for i, name in chosen]
        devices = [(t, receivers[name]) for t, (_, name) in zip(taken, chosen, strict=True)]
        solved = solve_scene(devices, heard, scene)
        answer.scene = scene = solved.scene
        answer.facts.update(solved.facts)
        answer.notes.extend(solved.notes)
    known = [s for c in heard if (s := scene.station(c)) is not None]
    if not known:
        raise DegenerateError(
            "the scene has none of the recording's stations",
            hint="its channels are "
            + ", ".join(str(s.channel) for s in scene.stations)
            + "; the recording has "
            + ", ".join(str(c) for c in heard),
        )
    channels = [s.channel for s in known]
    stations = (
        np.stack([s.position for s in known]),
        np.stack([s.rotation for s in known]),
        tuple(s.calibration for s in known),
    )
    every_ns = None if every_s is None else max(1, round(every_s * 1e9))
    parts = []
    for i, name in chosen:
        own, left_out = select_device_sweeps(sweeps, i, receivers[name], channels)
        followed = track_device(
            name, scene.frame, own, receivers[name], stations, channels, every_ns
        )
        parts.append((own, followed))
        for reasons in (left_out, followed.rejected):
            for reason, number in reasons.items():
                answer.rejected[reason] = answer.rejected.get(reason, 0) + number
    answer.trajectories = tuple(f.trajectory for _, f in parts)
    _account(answer, parts, channels)
    _remark(answer, parts)
    _remark_stations(answer)
    return answer


def _account(
    answer: DeviceSolution, parts: list[tuple[DeviceSweeps, TrackedDevice]], channels: list[int]
) -> None:
    """Residuals and numbers of sweeps by channel."""
    column = np.concatenate([own.station for own, _ in parts])
    used = np.concatenate([f.used for _, f in parts])
    answer.row = np.concatenate([own.row for own, _ in parts])
    answer.residual = np.concatenate([f.residual for _, f in parts])
    for i, channel in enumerate(channels):
        mine = column == i
        answer.residuals[channel] = answer.residual[mine & used]
        answer.used[channel] = int(np.count_nonzero(mine & used))
        answer.unused[channel] = int(np.count_nonzero(mine & ~used))
    answer.facts["angle_sigma_rad"] = float(max(f.sigma for _, f in parts))
    answer.facts["lasting_angle_sigma_rad"] = float(max(f.lasting_sigma for _, f in parts))
    if any(s.calibration.source in ("generic", "estimated") for s in answer.scene.stations):
        answer.facts["calibration_sigma_rad"] = CALIBRATION_SIGMA_RAD
    answer.facts["station_residual_rad"] = {
        str(c): robust_sigma(r) for c, r in answer.residuals.items()
    }


def _remark_stations(answer: DeviceSolution) -> None:
    """Stations that most poses do without."""
    wrong = [c for c, used in answer.used.items() if used < answer.unused[c]]
    if wrong and len(wrong) < len(answer.used) and any(len(t) for t in answer.trajectories):
        answer.notes.append(
            f"most sweeps of the station on channel {', '.join(map(str, wrong))} contradict the "
            "other stations: it was moved since the scene was solved, or it is seen by a mirror"
        )


def _remark(answer: DeviceSolution, parts: list[tuple[DeviceSweeps, TrackedDevice]]) -> None:
    for _, followed in parts:
        name, number = followed.trajectory.device, len(followed.trajectory)
        if number == 0:
            answer.notes.append(
                f"{name}: no pose; its photodiodes do not fit the receiver, the scene is of "
                "another place, or too few are seen at a time"
            )
            continue
        if followed.from_behind > BEHIND:
            answer.notes.append(
                f"{name}: {followed.from_behind:.0%} of its sweeps come from behind their "
                "photodiodes: places or normals of the receiver are mirrored or out of order"
            )
        if followed.ambiguous:
            answer.notes.append(
                f"{name}: flat and under one station, so that two orientations explain its "
                f"angles; {followed.ambiguous} moments stand on a choice that is not certain"
            )
