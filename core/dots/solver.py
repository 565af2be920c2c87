"""Camera frames of a dot sheet to poses in metres on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec, codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import FEW_DOTS, locate
from locatk.core.dots.localization.located import Located, nothing
from locatk.core.dots.published.localization import locate_paper
from locatk.core.dots.results import DotDetection, DotFacts, FrameOutcome
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

METHODS = ("lattice", "paper")

LOADED = 6_000_000
"""Pixels of frames of one size that are in memory at once."""

RIM = 12.0
"""Pitches by which the middle of a frame may lie outside of the printed area whose dots
it still sees."""

UNREADABLE = "unreadable_frame"
OTHER_SIZE = "not_of_the_cameras_size"
OFF_SHEET = "off_sheet"


@dataclass(frozen=True)
class SolveOptions:
    """How to solve.

    Attributes
    ----------
    method : str
        ``"lattice"``, or ``"paper"`` for the algorithm as published.
    camera : Camera, optional
        Without it the centre of the frame is the camera's, and the bend of its lens is
        estimated in each frame.
    """

    method: str = "lattice"
    camera: Camera | None = None


def solve(
    frames: Sequence[Frames], manifest: Manifest, options: SolveOptions | None = None
) -> Solution:
    """Poses of every camera on the sheets of ``manifest``.

    A pose is where the camera's centre lies on the sheet, with the direction of the image's
    right as heading; roll, pitch and height are not estimated. A camera that sees several
    sheets whose places on the floor are unknown has a trajectory on each.

    Raises
    ------
    InputError
        There is no such method, or the manifest names an unknown codec.
    """
    options = options or SolveOptions()
    if options.method not in METHODS:
        raise InputError(
            f"no method {options.method!r} for dots", hint=f"Known: {', '.join(METHODS)}"
        )
    code = codec(manifest.codec)
    outcomes: list[FrameOutcome] = []
    detections: list[DotDetection] = []
    trajectories: list[Trajectory] = []
    astray: list[NDArray[np.float64]] = []
    for camera_frames in frames:
        located = _locate_all(camera_frames, code, options)
        accepted = np.flatnonzero(located.accepted)
        sheet = np.full(len(located), -1, np.intp)
        sheet[accepted] = manifest.find(
            located.grid[accepted], located.section[accepted], slack=RIM
        )
        off = accepted[sheet[accepted] < 0]
        located.rejected[off] = OFF_SHEET
        astray += list(located.grid[off[:1]])
        poses = _poses(located, sheet, manifest)
        outcomes += _outcomes(camera_frames, located)
        detections += _detections(camera_frames, located, sheet, poses, manifest)
        trajectories += _trajectories(camera_frames, sheet, poses, manifest)
    rejected = Counter(frame.rejected for frame in outcomes if frame.rejected)
    return Solution(
        system="dots",
        method=options.method,
        trajectories=tuple(trajectories),
        rejected=dict(sorted(rejected.items())),
        detections=tuple(detections),
        artifact=manifest,
        warnings=_warnings(options, manifest, rejected, astray),
        facts=DotFacts(tuple(outcomes)),
    )


def _locate_all(frames: Frames, code: Codec, options: SolveOptions) -> Located:
    located = nothing(len(frames), FEW_DOTS)
    find = _locate_paper if options.method == "paper" else locate
    for indices, images in _batches(frames, located.rejected, options.camera):
        located.keep(indices, find(images, code, options.camera))
    return located


def _batches(
    frames: Frames, rejected: NDArray[np.object_], camera: Camera | None
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """Frames of one size at a time, with their indices; what is wrong goes to ``rejected``."""
    held: dict[tuple[int, ...], list[int]] = {}
    images: dict[int, NDArray[np.uint8]] = {}
    for index in range(len(frames)):
        try:
            image = frames.images[index]
        except InputError:
            rejected[index] = UNREADABLE
            continue
        if camera is not None and image.shape != camera.size[::-1]:
            rejected[index] = OTHER_SIZE
            continue
        images[index] = image
        same = held.setdefault(image.shape, [])
        same.append(index)
        if len(same) * image.size >= LOADED:
            yield np.array(same), np.stack([images.pop(k) for k in same])
            same.clear()
    for same in filter(None, held.values()):
        yield np.array(same), np.stack([images.pop(k) for k in same])


def _locate_paper(images: NDArray[np.uint8], code: Codec, camera: Camera | None = None) -> Located:
    """The published algorithm's answers; for lack of better its quality is the confidence."""
    located = nothing(len(images), FEW_DOTS)
    for k, image in enumerate(images):
        pose = locate_paper(image, code, camera)
        located.grid[k] = pose.x, pose.y
        located.section[k] = pose.section
        located.heading[k] = pose.heading_rad
        located.dots[k] = pose.dots
        located.corrected[k] = pose.corrected_bits
        located.confidence[k] = pose.quality
        located.rejected[k] = pose.rejected or ""
    return located


@dataclass(frozen=True)
class _Poses:
    """Of all frames, without meaning where there is no sheet: (n, 2) m, (n,) rad, (n, 3, 3)."""

    position: NDArray[np.float64]
    heading: NDArray[np.float64]
    covariance: NDArray[np.float64]


def _poses(located: Located, sheet: NDArray[np.intp], manifest: Manifest) -> _Poses:
    n = len(located)
    poses = _Poses(np.full((n, 2), np.nan), np.full(n, np.nan), np.full((n, 3, 3), np.nan))
    for number in np.unique(sheet[sheet >= 0]):
        on = sheet == number
        jacobian = manifest.jacobian(int(number))
        poses.position[on] = manifest.to_metres(int(number), located.grid[on])
        right = np.column_stack([np.cos(located.heading[on]), -np.sin(located.heading[on])])
        x, y = (right @ jacobian.T).T
        poses.heading[on] = np.arctan2(y, x)
        full = np.eye(3)
        full[:2, :2] = jacobian
        poses.covariance[on] = full @ located.covariance[on] @ full.T
    return poses


def _outcomes(frames: Frames, located: Located) -> list[FrameOutcome]:
    return [
        FrameOutcome(
            time_s=frames.time_ns[k] * 1e-9,
            frame=frames.names[k],
            dots=int(located.dots[k]),
            corrected_bits=int(located.corrected[k]),
            confidence=float(located.confidence[k]),
            rejected=located.rejected[k] or None,
        )
        for k in range(len(frames))
    ]


def _detections(
    frames: Frames,
    located: Located,
    sheet: NDArray[np.intp],
    poses: _Poses,
    manifest: Manifest,
) -> list[DotDetection]:
    return [
        DotDetection(
            time_s=frames.time_ns[k] * 1e-9,
            frame=frames.names[k],
            x_m=float(poses.position[k, 0]),
            y_m=float(poses.position[k, 1]),
            heading_rad=float(poses.heading[k]),
            confidence=float(located.confidence[k]),
            corrected_bits=int(located.corrected[k]),
            dots=int(located.dots[k]),
            grid_x=float(located.grid[k, 0]),
            grid_y=float(located.grid[k, 1]),
            sheet=manifest.sheets[sheet[k]].id,
        )
        for k in np.flatnonzero(sheet >= 0)
    ]


def _trajectories(
    frames: Frames, sheet: NDArray[np.intp], poses: _Poses, manifest: Manifest
) -> Iterator[Trajectory]:
    """One a frame of reference; the device's name bears it where there are several."""
    names = np.array([manifest.frame(k) for k in range(len(manifest.sheets))], object)
    seen = list(dict.fromkeys(names[sheet[sheet >= 0]]))
    for name in seen or [names[0]]:
        on = np.flatnonzero((sheet >= 0) & (names[sheet] == name))
        covariance = np.full((len(on), 6, 6), np.nan)
        plane = np.array([0, 1, 5])
        covariance[:, plane[:, None], plane] = poses.covariance[on]
        yield Trajectory(
            device=frames.device if len(seen) < 2 else f"{frames.device}-{name}",
            frame=str(name),
            time_ns=frames.time_ns[on],
            position=np.column_stack([poses.position[on], np.zeros(len(on))]),
            quaternion=quaternion_from_heading(poses.heading[on]),
            covariance=covariance,
        )


def _warnings(
    options: SolveOptions,
    manifest: Manifest,
    rejected: Counter[str],
    astray: list[NDArray[np.float64]],
) -> tuple[SolverWarning, ...]:
    warnings = []
    if options.method == "paper":
        warnings.append(
            SolverWarning(
                "no_uncertainty",
                "the published method knows no uncertainty: its confidence is a quality",
            )
        )
    if options.camera is None:
        lens = "estimated anew in each" if options.method != "paper" else "taken as flat"
        warnings.append(
            SolverWarning(
                "no_camera_model",
                f"no camera model: poses are of the middle of the frame, its lens {lens}",
            )
        )
    if rejected[OFF_SHEET]:
        x, y = astray[0]
        warnings.append(
            SolverWarning(
                "frames_off_sheet",
                f"{rejected[OFF_SHEET]} frames show the pattern off all sheets of the manifest, "
                f"the first at {x:.1f}, {y:.1f}: is it the manifest of another sheet?",
            )
        )
    if rejected["no_code"] > max(3, sum(rejected.values()) // 2):
        warnings.append(
            SolverWarning(
                "frames_without_code",
                f"{rejected['no_code']} frames show no place of the codec {manifest.codec!r}: no "
                "pattern in sight, or a sheet printed with another codec",
            )
        )
    return tuple(warnings)
