"""Camera frames of a dot sheet to poses in metres on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec, codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.locate import ACCEPTED, REASONS, Located, locate
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

METHODS = ("lattice", "paper")

LOADED = 256
"""Frames that are in memory at once."""

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
    outcomes: list[dict[str, Any]] = []
    detections: list[dict[str, Any]] = []
    trajectories: list[Trajectory] = []
    astray: list[NDArray[np.float64]] = []
    for camera_frames in frames:
        answer = _locate_all(camera_frames, code, options)
        sheet = np.full(len(camera_frames), -1, np.intp)
        accepted = answer.reasons == ""
        sheet[accepted] = manifest.find(
            answer.located.grid[accepted], answer.located.section[accepted], slack=RIM
        )
        off = accepted & (sheet < 0)
        answer.reasons[off] = OFF_SHEET
        astray.extend(answer.located.grid[off][:1])
        on_sheet, pose = _poses(answer.located, sheet, manifest)
        outcomes += _outcomes(camera_frames, answer)
        detections += _detections(camera_frames, answer, manifest, sheet, on_sheet, pose)
        trajectories += _trajectories(camera_frames.device, camera_frames, manifest, sheet, pose)
    rejected = Counter(frame["rejected"] for frame in outcomes if frame["rejected"])
    return Solution(
        system="dots",
        method=options.method,
        trajectories=tuple(trajectories),
        rejected=dict(sorted(rejected.items())),
        detections=detections,
        artifact=manifest,
        notes=_notes(options, manifest, rejected, astray),
        facts={"frames": outcomes},
    )


@dataclass
class _Answer:
    """What was found in the frames of one camera; a reason is ``""`` where it is a place."""

    located: Located
    reasons: NDArray[np.object_]


def _locate_all(frames: Frames, code: Codec, options: SolveOptions) -> _Answer:
    from locatk.core.dots.locate import _keep, _nothing

    located = _nothing(len(frames))
    reasons = np.full(len(frames), "", object)
    find = _paper if options.method == "paper" else locate
    for indices, images in _batches(frames, reasons, options.camera):
        part = find(images, code, options.camera)
        _keep(located, indices, part)
        reasons[indices] = [REASONS.get(int(k), "") for k in part.outcome]
    return _Answer(located, reasons)


def _batches(
    frames: Frames, reasons: NDArray[np.object_], camera: Camera | None
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """Frames of one size at a time, with their indices; what is wrong goes to ``reasons``."""
    for start in range(0, len(frames), LOADED):
        by_size: dict[tuple[int, int], list[tuple[int, NDArray[np.uint8]]]] = {}
        for index in range(start, min(start + LOADED, len(frames))):
            try:
                image = frames.images[index]
            except InputError:
                reasons[index] = UNREADABLE
                continue
            if camera is not None and image.shape != camera.size[::-1]:
                reasons[index] = OTHER_SIZE
                continue
            by_size.setdefault((image.shape[0], image.shape[1]), []).append((index, image))
        for found in by_size.values():
            yield np.array([index for index, _ in found]), np.stack([image for _, image in found])
