"""Calibration of a floor as built: the poses of its sheets, and the errors of their print.

Frames that cross a seam show the relative pose of two sheets
(:mod:`~locatk.core.dots.localization.separation`, :mod:`.seam_measurements`); all of them together
determine the poses of all sheets in the frame of one, the datum (:mod:`.floor_fit`).

What is not observable: from frames alone, neither the scale of the print nor its errors inside of a
sheet, because the scale of a frame is known from the pitch alone; and of the errors of the print
only the difference along a seam, which is part of the covariance. With truth (a motion capture
system, a stage) scale and errors are estimated as well, as far as the truth is better than they
are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.calibration.camera import CalibrateOptions, calibrate
from locatk.core.dots.calibration.camera_views import MIN_CALIBRATION_FRAMES
from locatk.core.dots.calibration.floor_fit import (
    GROSS_OUTLIER_SIGMAS,
    FloorFit,
    FloorProblem,
    TruthObservations,
    cross_validate,
    fit_floor,
    lay_out_unknowns,
)
from locatk.core.dots.calibration.floor_frame import BuiltSheet, build_sheets
from locatk.core.dots.calibration.seam_measurements import (
    SeamMeasurement,
    add_systematic_errors,
    crop_overlaps,
    measure_seam,
    refuse_contained_tiles,
)
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec, codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import (
    TOO_FEW_DOTS,
    LocalizedFrames,
    localize_frames,
    unlocalized_frames,
)
from locatk.core.dots.localization.recordings import OTHER_SIZE, batches, find_sheets
from locatk.core.dots.localization.seams import may_show_seam
from locatk.core.dots.localization.separation import separate_sheets
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import DegenerateError, InputError
from locatk.core.evaluation.association import associate
from locatk.core.geometry import (
    heading_from_quaternion,
    quaternion_from_heading,
    rotation_matrix_2d,
    umeyama,
    wrap_angle,
)
from locatk.core.trajectory import Trajectory, has_orientation

Array = NDArray[np.float64]

MIN_SEAM_FRAMES = 3
"""Least number of frames that connect two sheets: of two that contradict each other, neither can be
trusted."""

MIN_TRUTH_FRAMES = 10
"""Least number of poses with truth that connect a sheet to the frame of the truth."""

MIN_TRUTH_EXTENT_MM = 20.0
"""Least extent of these poses; a shorter one determines no direction."""

MAX_TRUTH_FRAMES = 1500
"""Maximum number of poses with truth that are fitted of each recording, spread evenly over it."""

MAX_LISTED_SHEETS = 6
"""Maximum number of sheets that an error names."""

SEAM_HINT = (
    "Move the camera slowly across each seam, at several places, or give --truth; remove sheets "
    "that are not part of the floor from the manifest"
)

TRUTH_HINT = (
    "Check --offset, and that the truth is of these recordings; or move the camera across seams"
)


@dataclass(frozen=True)
class FloorRecording:
    """Recording of one camera over the floor.

    Attributes
    ----------
    name : str
    frames : Frames
    camera : Camera, optional
        Default: estimated from the frames.
    truth : Trajectory, optional
        Of the body that carries the camera, in any frame with z up. Recordings with the same object
        have the frame and the camera's pose on the body in common.
    offset_s : float
        Seconds to add to the stamps of the frames to get those of the truth.
    """

    name: str
    frames: Frames
    camera: Camera | None = None
    truth: Trajectory | None = None
    offset_s: float = 0.0


@dataclass(frozen=True)
class SeamReport:
    """Frames that connect two sheets.

    Attributes
    ----------
    sheets : (str, str)
        Identifiers.
    frames : int
        Number of frames that were used.
    rms_mm, rms_rad : float
        Root mean square deviation of the frames from the result.
    """

    sheets: tuple[str, str]
    frames: int
    rms_mm: float
    rms_rad: float


@dataclass(frozen=True)
class FloorReport:
    """Floor as built.

    Attributes
    ----------
    manifest : Manifest
    datum : str
        Identifier of the sheet that keeps its pose.
    sheets : tuple of BuiltSheet
    seams : tuple of SeamReport
    unplaced : tuple of str
        Sheets without a position: no frame shows them, or too few of the frames that connect them
        with others agree.
    frames, localized, seam_frames, truth_frames : int
        Number of frames, of those with a pose on a sheet, with a measured seam, and with truth.
    rejected : int
        Number of seams and poses that contradict the others.
    fit : FloorFit
        With the noise of the observations.
    scale, sigma_scale : (x, y)
        Of the print relative to that of the given manifest, and their standard deviations; nan
        without truth.
    rms_rigid_mm, rms_mm : float
        Root mean square error of held-out poses against the truth: with a pose of each sheet and
        the scale, and with the maps of distortions as well; nan without truth.
    cameras : dict of str to Camera
        Of recordings for which it was estimated.
    notes : tuple of str
    """

    manifest: Manifest
    datum: str
    sheets: tuple[BuiltSheet, ...]
    seams: tuple[SeamReport, ...]
    unplaced: tuple[str, ...]
    frames: int
    localized: int
    seam_frames: int
    truth_frames: int
    rejected: int
    fit: FloorFit
    scale: tuple[float, float]
    sigma_scale: tuple[float, float]
    rms_rigid_mm: float
    rms_mm: float
    cameras: dict[str, Camera]
    notes: tuple[str, ...]


def calibrate_floor(
    recordings: Sequence[FloorRecording],
    manifest: Manifest,
    advance: Callable[[], None] = lambda: None,
) -> FloorReport:
    """Estimate the poses of the sheets of a floor, and with truth the errors of their print.

    Parameters
    ----------
    recordings : sequence of FloorRecording
    manifest : Manifest
        Sheets with or without positions; those with positions are searched within
        :data:`~locatk.core.dots.localization.separation.MAX_POSITION_ERROR_MM` of them.
    advance : callable
        Called twice for each frame, when it is localized and when it is examined for seams.

    Raises
    ------
    DegenerateError
        The frames do not connect all sheets that they show, or not all tiles, or contradict each
        other at all seams; there are neither seams nor usable truth; or the camera of a recording
        cannot be estimated.
    InputError
        The manifest has a single sheet and there is no truth, a tile is inside of another one, the
        codec is unknown, or a camera has frames of another size.
    """
    has_truth = any(recording.truth is not None for recording in recordings)
    if len(manifest.sheets) < 2 and not has_truth:
        raise InputError(
            "the manifest has a single sheet, and there is no truth",
            hint="Without truth, only the relative poses of several sheets can be estimated",
        )
    if any(sheet.id == "floor" and sheet.position_mm is None for sheet in manifest.sheets):
        raise InputError(
            "a sheet is named 'floor', which is the name of the frame of all sheets",
            hint="Rename it in the manifest",
        )
    refuse_contained_tiles(manifest)
    code = codec(manifest.codec)
    examined = [
        _examine(index, recording, manifest, code, advance)
        for index, recording in enumerate(recordings)
    ]
    if any(sheet.position_mm is None for sheet in manifest.sheets):
        # The first frames give sheets rough positions, by which more are recognised.
        first = [seam for each in examined for seam in _measure_seams(each, manifest, code)]
        rough = _with_rough_positions(manifest, first)
    else:
        rough = manifest
    seams: list[SeamMeasurement] = []
    for each in examined:
        seams += _measure_seams(each, rough, code, advance, is_last=True)
    manifest = crop_overlaps(manifest, seams)
    seams = add_systematic_errors(seams, manifest.pitch_mm)
    truths = list(_truth_observations(examined, manifest))
    sheets = _visible_sheets(manifest, examined, seams)
    require_connected(manifest, sheets, initial_poses(manifest, sheets, seams, truths))
    unused = unused_truth(truths) if has_truth else ""
    if not seams and not _truth_edges(truths):
        raise DegenerateError(
            unused or "no frame shows a seam between two sheets",
            hint=TRUTH_HINT if unused else SEAM_HINT,
        )
    given, problem, state, fit = fit_consistent_sheets(manifest, sheets, seams, truths)
    validation = cross_validate(fit) if fit.problem.truths else (math.nan, math.nan)
    if fit.problem.layout.nodes and validation[1] > validation[0]:
        fit = fit_floor(replace(problem, layout=replace(problem.layout, nodes={})), state)
        validation = validation[0], validation[0]
    notes = [unused] if unused else []
    return _report(manifest, examined, given, fit, validation, [*notes, *notes_of(given, fit)])


# ---- frames


@dataclass(frozen=True)
class _Examined:
    """Recording with the poses of its frames on the grid.

    ``sheet_numbers`` (n,) is the sheet of each frame, -1 if it has none; ``near_seam`` (n,) are the
    frames that may show several sheets, without those that were found to show one.
    """

    index: int
    recording: FloorRecording
    camera: Camera
    localized: LocalizedFrames
    sheet_numbers: NDArray[np.intp]
    near_seam: NDArray[np.bool_]


def _examine(
    index: int,
    recording: FloorRecording,
    manifest: Manifest,
    code: Codec,
    advance: Callable[[], None],
) -> _Examined:
    """Localize the frames of a recording on the grid, and estimate its camera if it has none."""
    frames, camera = recording.frames, recording.camera
    localized, numbers = _localize(frames, manifest, code, camera, advance)
    if len(frames) and (localized.rejected == OTHER_SIZE).all():
        raise InputError(
            f"no frame of {recording.name} has the size of the camera",
            hint="Calibrate the camera at the resolution of the recording",
        )
    near_seam = may_show_seam(localized, numbers, manifest)
    if camera is None:
        inner = np.flatnonzero(localized.accepted & (numbers >= 0) & ~near_seam)
        if len(inner) < MIN_CALIBRATION_FRAMES:
            inner = np.arange(len(frames))
        try:
            camera = calibrate(_select(frames, inner), manifest, CalibrateOptions()).camera
        except DegenerateError as error:
            raise DegenerateError(
                f"the camera of {recording.name} cannot be estimated: {error.message}",
                hint="Give it with --camera, from `locatk calibrate camera`",
            ) from None
        localized, numbers = _localize(frames, manifest, code, camera, lambda: None)
        near_seam = may_show_seam(localized, numbers, manifest)
    return _Examined(index, recording, camera, localized, numbers, near_seam)


def _select(frames: Frames, indices: NDArray[np.int64]) -> Frames:
    """Return some frames, still loaded on access."""
    return Frames(
        frames.device,
        frames.time_ns[indices],
        tuple(frames.names[k] for k in indices),
        _SelectedImages(frames.images, indices),
    )


class _SelectedImages(Sequence[NDArray[np.uint8]]):
    """Some of a sequence of images."""

    def __init__(self, images: Sequence[NDArray[np.uint8]], indices: NDArray[np.int64]) -> None:
        self._images, self._indices = images, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, number: Any) -> Any:
        return self._images[int(self._indices[number])]


def _localize(
    frames: Frames,
    manifest: Manifest,
    code: Codec,
    camera: Camera | None,
    advance: Callable[[], None],
) -> tuple[LocalizedFrames, NDArray[np.intp]]:
    """Localize frames on the grid; return them and the sheet of each."""
    localized = unlocalized_frames(len(frames), TOO_FEW_DOTS)
    every = np.arange(len(frames))
    for indices, images in batches(frames, every, localized.rejected, camera):
        localized.update(indices, localize_frames(images, code, camera, other_codec_odds=0))
        for _ in indices:
            advance()
    return localized, find_sheets(localized, manifest)


def _measure_seams(
    examined: _Examined,
    manifest: Manifest,
    code: Codec,
    advance: Callable[[], None] = lambda: None,
    *,
    is_last: bool = False,
) -> Iterator[SeamMeasurement]:
    """Yield the relative poses of the sheets in each frame that shows several.

    With ``is_last``, frames that show a single sheet are no longer counted as near a seam.
    """
    images = examined.recording.frames.images
    for frame in range(len(images)):
        advance()
        if not examined.near_seam[frame]:
            continue
        views = separate_sheets(images[frame], manifest, code, examined.camera)
        if is_last and len(views) == 1 and views[0].number == examined.sheet_numbers[frame]:
            examined.near_seam[frame] = False
        seam = measure_seam(views, manifest, examined.camera, examined.index, frame)
        if seam is not None:
            yield seam


def _truth_observations(
    examined: list[_Examined], manifest: Manifest
) -> Iterator[TruthObservations]:
    """Yield the poses on each sheet that have truth, of each recording."""
    alignments: dict[int, int] = {}
    for each in examined:
        truth = each.recording.truth
        if truth is not None:
            alignment = alignments.setdefault(id(truth), len(alignments))
            yield from _compare_with_truth(each, truth, alignment, manifest)


def _compare_with_truth(
    examined: _Examined, truth: Trajectory, alignment: int, manifest: Manifest
) -> Iterator[TruthObservations]:
    """Yield the poses on each sheet that have truth."""
    recording, localized = examined.recording, examined.localized
    is_used = localized.accepted & (examined.sheet_numbers >= 0) & ~examined.near_seam
    frames = np.flatnonzero(is_used)
    stamps = recording.frames.time_ns[frames]
    poses = Trajectory(
        recording.frames.device,
        "grid",
        stamps,
        np.zeros((len(frames), 3)),
        quaternion_from_heading(np.zeros(len(frames))),
        np.full((len(frames), 6, 6), np.nan),
    )
    match = associate(poses, truth, offset_s=recording.offset_s)
    rows = np.unique(np.linspace(0, len(match) - 1, min(len(match), MAX_TRUTH_FRAMES)).astype(int))
    frames, truth_mm = frames[match.index[rows]], match.truth[rows] * 1e3
    headings = heading_from_quaternion(match.truth_quaternion[rows])
    if not has_orientation(truth).all():
        headings = np.full(len(rows), np.nan)
    for number in np.unique(examined.sheet_numbers[frames]).tolist():
        here = examined.sheet_numbers[frames] == number
        indices = frames[here]
        nominal = _on_paper(manifest, number)
        position, heading, covariance = nominal.poses_in_metres(
            0, localized.grid[indices], localized.heading[indices], localized.covariance[indices]
        )
        variance = np.stack(
            [(covariance[:, 0, 0] + covariance[:, 1, 1]) / 2 * 1e6, covariance[:, 2, 2]], axis=1
        )
        yield TruthObservations(
            number,
            alignment,
            recording.frames.time_ns[indices],
            position * 1e3,
            heading,
            variance,
            truth_mm[here, :2],
            headings[here],
        )


def _on_paper(manifest: Manifest, number: int) -> Manifest:
    """Return a manifest of one sheet, as designed and in the frame of its paper."""
    sheet = replace(
        manifest.sheets[number],
        position_mm=None,
        heading_deg=0.0,
        covariance_mm_deg=None,
        distortion=None,
        distortion_sigma_mm=(0.0, 0.0),
        distortion_sigma_deg=0.0,
    )
    return replace(manifest, sheets=(sheet,))


# ---- initial guess


Node = tuple[str, int]
"""Sheet or frame of a truth, with its number."""

SHEET, TRUTH = "sheet", "truth"

Pair = frozenset[int]
"""Numbers of two sheets."""


def _visible_sheets(
    manifest: Manifest, examined: list[_Examined], seams: list[SeamMeasurement]
) -> list[int]:
    """Return the sheets that are part of the floor, the datum first.

    These are all tiles, and other sheets that a frame shows.
    """
    visible = {number for each in examined for number in each.sheet_numbers.tolist() if number >= 0}
    visible |= {number for seam in seams for number in seam.numbers}
    tiles = {k for k, sheet in enumerate(manifest.sheets) if sheet.position_mm is not None}
    if not visible:
        raise DegenerateError(
            "no frame shows a sheet of the manifest", hint="Is it the manifest of another floor?"
        )

    def from_origin(number: int) -> tuple[float, int]:
        position = manifest.sheets[number].position_mm
        return (math.inf if position is None else math.hypot(*position), number)

    return sorted(visible | tiles, key=from_origin)[:1] + sorted(
        sorted(visible | tiles, key=from_origin)[1:]
    )


def initial_poses(
    manifest: Manifest,
    sheets: list[int],
    seams: Sequence[SeamMeasurement],
    truths: Sequence[TruthObservations],
    min_frames: int = MIN_SEAM_FRAMES,
    rejected: Mapping[Pair, int] | None = None,
) -> dict[Node, Array]:
    """Return the poses (x, y [mm], heading [rad]) of all nodes connected with the datum.

    Each edge has the median of its measurements, of which there must be ``min_frames`` and more
    than were ``rejected``.
    """
    edges = _seam_edges(seams, min_frames, rejected or {}) | _truth_edges(truths)
    sheet = manifest.sheets[sheets[0]]
    x, y = sheet.position_mm or (0.0, 0.0)
    poses: dict[Node, Array] = {
        (SHEET, sheets[0]): np.array([x, y, math.radians(sheet.heading_deg)])
    }
    queue = list(poses)
    while queue:
        node = queue.pop(0)
        for (first, second), relative in edges.items():
            if first == node and second not in poses:
                poses[second] = _compose(poses[first], relative)
                queue.append(second)
            if second == node and first not in poses:
                poses[first] = _compose(poses[second], _inverse(relative))
                queue.append(first)
    return poses


def _seam_edges(
    seams: Sequence[SeamMeasurement], min_frames: int, rejected: Mapping[Pair, int]
) -> dict[tuple[Node, Node], Array]:
    """Return the median relative pose of each two sheets that enough frames show together."""
    relative: dict[tuple[Node, Node], list[Array]] = {}
    for first, second, point, pose in _pairs(seams):
        if first > second:
            # Of the second paper's corner, from the pose of a point on it.
            corner = pose[:2] - rotation_matrix_2d(pose[2]) @ point
            inverse = _inverse(np.append(corner, pose[2]))
            relative.setdefault(((SHEET, second), (SHEET, first)), []).append(inverse)
        else:
            corner = pose[:2] - rotation_matrix_2d(pose[2]) @ point
            both = (SHEET, first), (SHEET, second)
            relative.setdefault(both, []).append(np.append(corner, pose[2]))
    return {
        edge: _median_pose(np.array(poses))
        for edge, poses in relative.items()
        if len(poses) >= min_frames
        and len(poses) > rejected.get(frozenset(number for _, number in edge), 0)
    }


def count_frames(seams: Sequence[SeamMeasurement]) -> Counter[Pair]:
    """Return the number of measurements of each two sheets."""
    return Counter(frozenset((first, other)) for first, other, _, _ in _pairs(seams))


def _pairs(seams: Sequence[SeamMeasurement]) -> Iterator[tuple[int, int, Array, Array]]:
    """Yield first and other sheet, point and pose of each measurement."""
    for seam in seams:
        for k, number in enumerate(seam.numbers[1:]):
            yield seam.numbers[0], number, seam.points_mm[k], seam.poses[k]


def _median_pose(poses: Array) -> Array:
    """Return the median of poses (n, 3) whose headings are close to each other."""
    heading = poses[0, 2] + wrap_angle(poses[:, 2] - poses[0, 2])
    return np.append(np.median(poses[:, :2], axis=0), np.median(heading))


def _truth_edges(truths: Sequence[TruthObservations]) -> dict[tuple[Node, Node], Array]:
    """Return the pose of the frame of each truth on the sheets that have enough poses in it."""
    edges = {}
    for truth in truths:
        extent = np.ptp(truth.points_mm, axis=0).max(initial=0)
        if len(truth.time_ns) >= MIN_TRUTH_FRAMES and extent >= MIN_TRUTH_EXTENT_MM:
            fit = umeyama(truth.truth_mm, truth.points_mm, with_scale=False)
            angle = math.atan2(fit.rotation[1, 0], fit.rotation[0, 0])
            pose = np.append(fit.translation, angle)
            edges[(SHEET, truth.number), (TRUTH, truth.alignment)] = pose
    return edges


def _compose(pose: Array, relative: Array) -> Array:
    position = pose[:2] + rotation_matrix_2d(pose[2]) @ relative[:2]
    return np.append(position, wrap_angle(pose[2] + relative[2]))


def _inverse(pose: Array) -> Array:
    return np.append(-rotation_matrix_2d(-pose[2]) @ pose[:2], -pose[2])


def _with_rough_positions(manifest: Manifest, seams: list[SeamMeasurement]) -> Manifest:
    """Return the manifest with the positions of the sheets that seams connect."""
    if not seams:
        return manifest
    sheets = sorted({number for seam in seams for number in seam.numbers})
    poses = initial_poses(manifest, sheets, seams, [], 1)
    placed = list(manifest.sheets)
    for (_, number), (x, y, heading) in poses.items():
        placed[number] = replace(
            placed[number], position_mm=(x, y), heading_deg=math.degrees(heading)
        )
    return replace(manifest, sheets=tuple(placed))


def require_connected(manifest: Manifest, sheets: list[int], poses: dict[Node, Array]) -> None:
    """Refuse a floor of several parts."""
    missing = [number for number in sheets if (SHEET, number) not in poses]
    if not missing:
        return
    names = [manifest.sheets[number].id for number in missing]
    listed = ", ".join(names[:MAX_LISTED_SHEETS])
    more = f" and {len(names) - MAX_LISTED_SHEETS} more" if len(names) > MAX_LISTED_SHEETS else ""
    verb = "are" if len(names) > 1 else "is"
    raise DegenerateError(
        f"{listed}{more} {verb} not connected with {manifest.sheets[sheets[0]].id}: fewer than "
        f"{MIN_SEAM_FRAMES} frames show a seam between them",
        hint=SEAM_HINT,
    )


def unused_truth(truths: Sequence[TruthObservations]) -> str:
    """Return why some poses with truth cannot be used; empty if all can."""
    if not truths:
        return "no frame on a single sheet has truth at its time"
    aligned = {alignment for _, (_, alignment) in _truth_edges(truths)}
    unused = sum(len(truth.time_ns) for truth in truths if truth.alignment not in aligned)
    if not unused:
        return ""
    return (
        f"{unused} poses with truth cannot be used: at least {MIN_TRUTH_FRAMES} on one sheet, over "
        f"{MIN_TRUTH_EXTENT_MM:.0f} mm, are required"
    )


def fit_consistent_sheets(
    manifest: Manifest,
    sheets: list[int],
    seams: Sequence[SeamMeasurement],
    truths: Sequence[TruthObservations],
) -> tuple[FloorProblem, FloorProblem, Array, FloorFit]:
    """Fit a floor, without the sheets that too few consistent frames connect with the datum.

    A fit rejects frames that contradict the others. The rest connects two sheets only if it has
    still :data:`MIN_SEAM_FRAMES` and is the majority: otherwise it is unknown which frames are
    wrong.

    Returns
    -------
    given, problem : FloorProblem
        With all sheets, and without those that are left out.
    state : (size,) ndarray
        Initial guess of the unknowns of ``problem``.
    fit : FloorFit

    Raises
    ------
    DegenerateError
        No observations are left.
    """
    given: FloorProblem | None = None
    while True:
        poses = initial_poses(manifest, sheets, seams, truths)
        problem, state = floor_problem(manifest, sheets, seams, truths, poses)
        given = given or problem
        if not problem.seams and not problem.truths:
            raise DegenerateError(
                f"no sheet is connected with {manifest.sheets[sheets[0]].id}: at its seams, fewer "
                f"than {MIN_SEAM_FRAMES} frames agree, or as many do not",
                hint="Record these seams again, slowly, with the papers flat on the floor",
            )
        fit = fit_floor(problem, state)
        used = fit.problem
        rejected = count_frames(seams) - count_frames(used.seams)
        connected = initial_poses(
            manifest, sheets, used.seams, used.truths, MIN_SEAM_FRAMES, rejected
        )
        if all((SHEET, number) in connected for number in sheets) and (used.seams or used.truths):
            return given, problem, state, fit
        sheets = [number for number in sheets if (SHEET, number) in connected]
        seams = [seam for seam in seams if set(seam.numbers) <= set(sheets)]
        truths = [truth for truth in truths if truth.number in sheets and used.truths]


def floor_problem(
    manifest: Manifest,
    sheets: list[int],
    seams: Sequence[SeamMeasurement],
    truths: Sequence[TruthObservations],
    poses: dict[Node, Array],
) -> tuple[FloorProblem, Array]:
    """Return the problem of a floor and the initial guess of its unknowns."""
    if not all(truth.has_heading for truth in truths):
        truths = [replace(t, truth_headings=np.full(len(t.time_ns), np.nan)) for t in truths]
    numbers = sorted({truth.alignment for truth in truths if (TRUTH, truth.alignment) in poses})
    used = tuple(
        replace(truth, alignment=numbers.index(truth.alignment))
        for truth in truths
        if truth.alignment in numbers
    )
    layout = lay_out_unknowns(manifest, tuple(sheets), len(numbers))
    problem = FloorProblem(manifest, layout, tuple(seams), used)
    state = np.zeros(layout.size)
    for number in sheets[1:]:
        state[layout.pose(number)] = poses[SHEET, number]
    for index, number in enumerate(numbers):
        state[layout.alignment(index)[:3]] = _inverse(poses[TRUTH, number])
        first = next(truth for truth in used if truth.alignment == index)
        if first.has_heading:
            on_floor = first.headings + poses[SHEET, first.number][2]
            turn = wrap_angle(first.truth_headings - on_floor + poses[TRUTH, number][2])
            state[layout.alignment(index)[5]] = np.angle(np.exp(1j * turn).mean())
    return problem, state


# ---- report


def _report(
    manifest: Manifest,
    examined: list[_Examined],
    given: FloorProblem,
    fit: FloorFit,
    validation: tuple[float, float],
    notes: Sequence[str],
) -> FloorReport:
    """Return the result of a calibration."""
    problem = fit.problem
    built = build_sheets(fit)
    scale = sigma_scale = (math.nan, math.nan)
    if problem.layout.alignments:
        index = problem.layout.scale
        scale = _pair(1 + fit.state[index])
        sigma_scale = _pair(np.sqrt(np.diag(fit.covariance)[index]))
    placed = {sheet.number for sheet in built}
    return FloorReport(
        manifest=built_manifest(manifest, built, scale),
        datum=manifest.sheets[problem.layout.sheets[0]].id,
        sheets=built,
        seams=_seam_reports(fit),
        unplaced=tuple(
            sheet.id for number, sheet in enumerate(manifest.sheets) if number not in placed
        ),
        frames=sum(len(each.recording.frames) for each in examined),
        localized=sum(int((each.sheet_numbers >= 0).sum()) for each in examined),
        seam_frames=len(problem.seams),
        truth_frames=problem.truth_frames,
        rejected=len(given.seams) - len(problem.seams) + given.truth_frames - problem.truth_frames,
        fit=fit,
        scale=scale,
        sigma_scale=sigma_scale,
        rms_rigid_mm=validation[0],
        rms_mm=validation[1],
        cameras={
            each.recording.name: each.camera for each in examined if each.recording.camera is None
        },
        notes=tuple(notes),
    )


def notes_of(given: FloorProblem, fit: FloorFit) -> Iterator[str]:
    """Report what the calibration could not estimate."""
    manifest, total = given.manifest, count_frames(given.seams)
    kept = count_frames(fit.problem.seams)
    placed = fit.problem.layout.sheets
    for pair in sorted(total, key=sorted):
        rejected = total[pair] - kept[pair]
        if rejected and (kept[pair] < MIN_SEAM_FRAMES or kept[pair] <= rejected):
            first, other = (manifest.sheets[number].id for number in sorted(pair))
            yield f"{first} and {other}: {kept[pair]} of {total[pair]} frames at their seam agree"
    if fit.problem.seams and fit.hyperparameters.seam > GROSS_OUTLIER_SIGMAS:
        yield (
            f"frames at one seam differ {fit.hyperparameters.seam:.0f} times as much as the noise "
            "of their dots explains: is the floor flat, the lens calibrated, and does the floor "
            "consist of these sheets? Do not trust the standard deviations"
        )
    for number in given.layout.sheets:
        if number not in placed:
            yield (
                f"{manifest.sheets[number].id} has no position: its seams have fewer than "
                f"{MIN_SEAM_FRAMES} frames that agree, or as many that do not"
            )
    if not given.layout.nodes:
        yield (
            "the floor has too many sheets for a model of the errors of their print: the standard "
            "deviations are those of a print without errors"
        )
    if not given.truths and any(sheet.distortion for sheet in given.manifest.sheets):
        yield "the maps of the print in the given manifest are left out: they need --truth"
    if fit.problem.truths and not fit.problem.truths[0].has_heading:
        yield (
            "the truth has no orientation: it is assumed to be the position of the camera's centre"
        )


def built_manifest(
    manifest: Manifest, built: Sequence[BuiltSheet], scale: tuple[float, float]
) -> Manifest:
    """Return the manifest of a floor as built; ``scale`` is nan if it was not estimated.

    Sheets that are not among those built have no position, not even that of the design.
    """
    sheets = [
        replace(sheet, position_mm=None, heading_deg=0.0, covariance_mm_deg=None)
        for sheet in manifest.sheets
    ]
    for sheet in built:
        to_degrees = np.diag([1.0, 1.0, math.degrees(1)])
        covariance = to_degrees @ sheet.covariance @ to_degrees
        x, y, heading = sheet.pose.tolist()
        sheets[sheet.number] = replace(
            sheets[sheet.number],
            position_mm=(x, y),
            heading_deg=math.degrees(heading),
            covariance_mm_deg=tuple(tuple(row) for row in covariance.tolist()),
            distortion=sheet.distortion,
            distortion_sigma_mm=sheet.distortion_sigma_mm,
            distortion_sigma_deg=math.degrees(sheet.distortion_sigma_rad),
        )
    result = replace(manifest, sheets=tuple(sheets))
    if math.isfinite(scale[0]):
        result = replace(result, scale=(manifest.scale[0] * scale[0], manifest.scale[1] * scale[1]))
    return result


def _pair(values: Array) -> tuple[float, float]:
    first, second = values.tolist()
    return first, second


def _seam_reports(fit: FloorFit) -> tuple[SeamReport, ...]:
    """Return how well the measurements of each seam agree with the result."""
    sheets = fit.problem.manifest.sheets
    deviations: dict[tuple[int, int], list[Array]] = {}
    for first, other, deviation in fit.problem.seam_deviations(fit.state):
        deviations.setdefault((min(first, other), max(first, other)), []).append(deviation)
    reports = []
    for (first, other), values in sorted(deviations.items()):
        x, y, angle = np.sqrt(np.mean(np.square(values), axis=0)).tolist()
        names = sheets[first].id, sheets[other].id
        reports.append(SeamReport(names, len(values), math.hypot(x, y), angle))
    return tuple(reports)
