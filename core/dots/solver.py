"""Pipeline of the dots solver, from camera frames of a sheet to poses in metres on it.

The frames of each camera pass the stages detect, identify and localize
(:mod:`~locatk.core.dots.localization.frames`), which give a pose on the grid of the pattern; the
manifest of the printed sheets converts it to metres.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec, codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import (
    NO_CODE,
    TOO_FEW_DOTS,
    LocalizedFrames,
    unlocalized_frames,
)
from locatk.core.dots.localization.recordings import (
    INVERTED,
    MIRRORED,
    MIRRORED_AND_INVERTED,
    OFF_SHEET,
    count_frames_of_other_codecs,
    find_sheets,
    localize_recording,
)
from locatk.core.dots.localization.seams import relocalize_at_seams
from locatk.core.dots.localization.sheet_poses import (
    SheetPoses,
    frame_detections,
    sheet_poses,
    spatial_covariance,
)
from locatk.core.dots.published.localization import localize_published
from locatk.core.dots.results import DotDetection, DotFacts, FrameOutcome
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

METHODS = ("lattice", "paper")

MAX_TOLERATED_NO_CODE = 3
"""Number of frames without code up to which a session gets no warning; beyond it they must also be
most of the rejected frames."""


UNMIRROR = (
    "switch off the mirroring (flip) of the camera or its driver, or mirror the images back before "
    "the import"
)
UNINVERT = "switch off the negative effect of the camera, or invert the images before the import"
RECOGNIZED_FRAMES = {
    MIRRORED: ("mirrored_frames", "mirrored", UNMIRROR),
    INVERTED: ("inverted_frames", "inverted (light dots on dark paper)", UNINVERT),
    MIRRORED_AND_INVERTED: (
        "mirrored_and_inverted_frames",
        "mirrored and inverted",
        f"{UNMIRROR}; and {UNINVERT}",
    ),
}
"""Code of the warning, appearance and remedy of frames that show the pattern otherwise than
printed, by the reason of their rejection."""


@dataclass(frozen=True)
class SolveOptions:
    """Options of the solver.

    Attributes
    ----------
    method : str
        ``"lattice"`` or ``"paper"`` (the published method).
    camera : Camera, optional
        Default: its centre is the middle of the frame, and the distortion of its lens is estimated
        in each frame (``paper``: no distortion).
    """

    method: str = "lattice"
    camera: Camera | None = None


def solve(
    frames: Sequence[Frames], manifest: Manifest, options: SolveOptions | None = None
) -> Solution:
    """Estimate the poses of cameras on the sheets of ``manifest``.

    A pose is the position of the camera's centre on the sheet, with the direction of the image's
    right as heading; roll, pitch and height are not estimated. A camera over several sheets whose
    positions on the floor are unknown has a trajectory on each.

    Parameters
    ----------
    frames : sequence of Frames
        One element per camera.
    manifest : Manifest
    options : SolveOptions, optional

    Raises
    ------
    InputError
        The method or the codec of the manifest is unknown.
    """
    options = options or SolveOptions()
    if options.method not in METHODS:
        raise InputError(
            f"no method {options.method!r} for dots", hint=f"Known: {', '.join(METHODS)}"
        )
    code = codec(manifest.codec)
    localize = _localize_published if options.method == "paper" else None
    outcomes: list[FrameOutcome] = []
    detections: list[DotDetection] = []
    trajectories: list[Trajectory] = []
    off_sheet: list[NDArray[np.float64]] = []
    other_codecs: tuple[Counter[str], Counter[str]] = (Counter(), Counter())
    for camera_frames in frames:
        localized = localize_recording(camera_frames, manifest, code, options.camera, localize)
        sheet = find_sheets(localized, manifest)
        if options.method != "paper" and manifest.has_seams:
            relocalize_at_seams(camera_frames, localized, sheet, manifest, code, options.camera)
        counts = count_frames_of_other_codecs(
            camera_frames, localized.rejected, manifest, options.camera
        )
        for total, count in zip(other_codecs, counts, strict=True):
            total.update(count)
        off_sheet += list(localized.grid[localized.rejected == OFF_SHEET])
        poses = sheet_poses(localized, sheet, manifest)
        outcomes += _outcomes(camera_frames, localized)
        detections += frame_detections(camera_frames, localized, sheet, poses, manifest)
        trajectories += _trajectories(camera_frames, sheet, poses, manifest)
    rejected = Counter(frame.rejected for frame in outcomes if frame.rejected)
    return Solution(
        system="dots",
        method=options.method,
        trajectories=tuple(trajectories),
        rejected=dict(sorted(rejected.items())),
        detections=tuple(detections),
        artifact=manifest,
        warnings=_warnings(options, manifest, rejected, off_sheet, other_codecs),
        facts=DotFacts(tuple(outcomes)),
    )


def _localize_published(
    images: NDArray[np.uint8], code: Codec, camera: Camera | None = None
) -> LocalizedFrames:
    """Localize frames by the published algorithm; its quality stands in for the confidence."""
    result = unlocalized_frames(len(images), TOO_FEW_DOTS)
    for k, image in enumerate(images):
        pose = localize_published(image, code, camera)
        result.grid[k] = pose.x, pose.y
        result.section[k] = pose.section
        result.heading[k] = pose.heading_rad
        result.dots[k] = pose.dots
        result.corrected[k] = pose.corrected_bits
        result.confidence[k] = pose.quality
        result.rejected[k] = pose.rejected or ""
    return result


# ---- results


def _outcomes(frames: Frames, localized: LocalizedFrames) -> list[FrameOutcome]:
    """Return the outcome of every frame."""
    return [
        FrameOutcome(
            time_s=frames.time_ns[k] * 1e-9,
            frame=frames.names[k],
            dots=int(localized.dots[k]),
            corrected_bits=int(localized.corrected[k]),
            confidence=float(localized.confidence[k]),
            rejected=localized.rejected[k] or None,
        )
        for k in range(len(frames))
    ]


def _trajectories(
    frames: Frames, sheet: NDArray[np.intp], poses: SheetPoses, manifest: Manifest
) -> Iterator[Trajectory]:
    """Yield one trajectory per coordinate frame; if there are several, its name is appended."""
    names = np.array([manifest.frame(k) for k in range(len(manifest.sheets))], object)
    visited = list(dict.fromkeys(names[sheet[sheet >= 0]]))
    for name in visited or [names[0]]:
        indices = np.flatnonzero((sheet >= 0) & (names[sheet] == name))
        yield Trajectory(
            device=frames.device if len(visited) < 2 else f"{frames.device}-{name}",
            frame=str(name),
            time_ns=frames.time_ns[indices],
            position=np.column_stack([poses.position[indices], np.zeros(len(indices))]),
            quaternion=quaternion_from_heading(poses.heading[indices]),
            covariance=spatial_covariance(poses.covariance[indices]),
        )


def _warnings(
    options: SolveOptions,
    manifest: Manifest,
    rejected: Counter[str],
    off_sheet: list[NDArray[np.float64]],
    other_codecs: tuple[Counter[str], Counter[str]],
) -> tuple[SolverWarning, ...]:
    """Return the warnings of a session.

    ``off_sheet`` are grid coordinates of rejected frames, and ``other_codecs`` are numbers of
    frames for and against other codecs, see :func:`.count_frames_of_other_codecs`.
    """
    warnings = []
    if options.method == "paper":
        warnings.append(
            SolverWarning(
                "no_uncertainty",
                "the published method estimates no uncertainty: its confidence is a quality",
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
    for reason, (code, appearance, remedy) in RECOGNIZED_FRAMES.items():
        if count := rejected[reason]:
            message = f"{count} frames are {appearance} and have no pose: {remedy}"
            warnings.append(SolverWarning(code, message))
    located, contradicted = other_codecs
    if located:
        ((name, count),) = located.most_common(1)
        if count > contradicted[name]:
            message = (
                f"the sheets were printed with the codec {name!r}, not {manifest.codec!r} as in "
                f"the manifest: with it, {count} of the rejected frames that were tried are on "
                "the sheets. Correct the codec in the manifest"
            )
        else:
            message = (
                f"with the codec {name!r}, {count} of the rejected frames that were tried are on "
                f"the sheets, but {contradicted[name]} of those with a pose are not: do these "
                "frames show a sheet of another manifest?"
            )
        warnings.append(SolverWarning("other_codec", message))
    elif off_sheet:
        x, y = off_sheet[0]
        warnings.append(
            SolverWarning(
                "frames_off_sheet",
                f"{rejected[OFF_SHEET]} frames show the pattern off all sheets of the manifest, "
                f"the first at {x:.1f}, {y:.1f}: is it the manifest of another sheet?",
            )
        )
    if rejected[NO_CODE] > max(MAX_TOLERATED_NO_CODE, sum(rejected.values()) // 2):
        warnings.append(
            SolverWarning(
                "frames_without_code",
                f"{rejected['no_code']} frames show no place of the codec {manifest.codec!r}: no "
                "pattern in sight, or a sheet printed with another codec",
            )
        )
    return tuple(warnings)
