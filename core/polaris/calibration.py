"""Calibration of tags: positions and angles of the magnets as built, from several passes.

The magnets of tags that people build are off by degrees and tenths of millimetres, the same ones in
every pass: 6 degrees rms in the published recordings. Each pass measures all magnets in a frame of
its own. Passes are aligned with each other by rigid transforms, and their mean is aligned with the
nominal grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import Similarity, umeyama, wrap_angle
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.tag import AsBuiltTag, TagLayout, Tags, cell_positions, symbol_angles

Array = NDArray[np.float64]

MIN_PASSES = 2
"""Number of passes from which a tag is calibrated, and in which each magnet must be observed."""

MIN_MAGNETS = 3
"""Number of magnets that a pass must have observed: two positions have no shape."""

OUTLIER_RATIO = 4.0
"""Deviation of a pass from the others, relative to the median one, from which it is rejected."""

MIN_SPREAD = np.array([50e-6, 50e-6, math.radians(0.1)])
"""Lower limit of the spread of passes in x, y [m] and angle [rad]."""

MAX_ALIGNMENT_ROUNDS, ALIGNMENT_TOLERANCE = 50, 1e-10
"""Rounds of alignment and averaging, and the change in m and rad that ends them."""

MIN_REPORTED_STRETCH = 0.01
"""Relative stretch of a tag from which it is reported."""


@dataclass(frozen=True)
class TagPass:
    """Magnets of one tag in one pass, in the order of the tag's layout.

    Attributes
    ----------
    name : str
        Name of the pass in messages.
    tag_id : int
    observed : (M, 3) ndarray
        x and y in m and angle in rad of each magnet, in any frame of the pass; ``nan`` if it was
        not observed.
    sigma : (M, 3) ndarray
        Their standard deviations; ``nan`` if unknown.
    """

    name: str
    tag_id: int
    observed: Array
    sigma: Array


@dataclass(frozen=True)
class AsBuiltReport:
    """Calibration of one tag.

    Attributes
    ----------
    tag_id : int
    built : AsBuiltTag
    scatter_m, scatter_rad : (M,) ndarray
        Rms of the passes about each magnet's mean: of its position in the plane, and of its angle.
    passes : (M,) ndarray of int
        Number of passes that observed each magnet and were used.
    used, disagree : tuple of str
        Names of passes that were used, and of those that were rejected.
    stretch : float
        Length of the tag along the track relative to its design; mean of the passes.
    sigma_stretch : float
        Standard deviation of that mean, from the passes.
    """

    tag_id: int
    built: AsBuiltTag
    scatter_m: Array
    scatter_rad: Array
    passes: NDArray[np.int64]
    used: tuple[str, ...]
    disagree: tuple[str, ...]
    stretch: float
    sigma_stretch: float


@dataclass(frozen=True)
class TagCalibrationReport:
    """Calibration of a set of tags.

    Attributes
    ----------
    tags : Tags
        The given tags, with ``built`` of those that were calibrated.
    calibrated : tuple of AsBuiltReport
        By id.
    left_out : dict of str to str
        Name of each pass that was not used, with the reason.
    notes : tuple of str
    """

    tags: Tags
    calibrated: tuple[AsBuiltReport, ...]
    left_out: dict[str, str]
    notes: tuple[str, ...]


def tag_pass(tags: Tags, detection: TagDetection, name: str) -> TagPass | str:
    """Return a detection of a solution as a pass, or the reason why it cannot be used."""
    tag_id = detection.tag_id
    if tag_id is None:
        return f"not read: {detection.refused or 'no reason given'}".replace("_", " ")
    cells = layout_of(tags, tag_id).cells
    observed, sigma = np.full((2, len(cells), 3), np.nan)
    for magnet in detection.magnets:
        if magnet.cell is None or magnet.cell not in cells:
            continue
        index = cells.index(magnet.cell)
        observed[index] = magnet.x_m, magnet.y_m, magnet.angle_rad
        sigma[index] = magnet.sigma_x_m, magnet.sigma_y_m, magnet.sigma_angle_rad
    count = int(np.isfinite(observed[:, 0]).sum())
    if count < MIN_MAGNETS:
        return f"only {count} magnets were observed"
    return TagPass(name, int(tag_id), observed, sigma)


def calibrate(
    tags: Tags, passes: Sequence[TagPass], left_out: Mapping[str, str] | None = None
) -> TagCalibrationReport:
    """Estimate the magnets as built of each tag that was passed at least twice.

    Passes are aligned with each other as rigid shapes, and averaged with weights from their own
    standard deviations and from their scatter. The mean is aligned with the nominal grid by least
    squares over all magnets, so that it is independent of the pose of the tag. Of three passes or
    more, one that disagrees with the others is left out and reported.

    Parameters
    ----------
    tags : Tags
    passes : sequence of TagPass
    left_out : mapping of str to str, optional
        Passes that could not be used, with the reason; they are added to the report.

    Raises
    ------
    InputError
        No tag was passed twice, a magnet of a tag was observed less than twice, or the passes
        over a tag all disagree.
    """
    by_tag: dict[int, list[TagPass]] = {}
    for each in passes:
        by_tag.setdefault(each.tag_id, []).append(each)
    reasons, calibrated = dict(left_out or {}), []
    for tag_id, tag_passes in sorted(by_tag.items()):
        if len(tag_passes) < MIN_PASSES:
            reasons |= {each.name: f"the only one over tag {tag_id}" for each in tag_passes}
            continue
        report = _calibrate_tag(tags, tag_id, tag_passes)
        reasons |= dict.fromkeys(report.disagree, f"disagrees on tag {tag_id} with the others")
        calibrated.append(report)
    if not calibrated:
        details = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        raise InputError(
            f"no tag was read in {MIN_PASSES} passes ({details or 'there is no pass'})",
            hint="Pass each tag at least twice, better ten times",
        )
    built = {**tags.built, **{report.tag_id: report.built for report in calibrated}}
    notes = tuple(note for report in calibrated for note in _notes(tags, report))
    return TagCalibrationReport(replace(tags, built=built), tuple(calibrated), reasons, notes)


def _calibrate_tag(tags: Tags, tag_id: int, passes: Sequence[TagPass]) -> AsBuiltReport:
    """Estimate the magnets as built of one tag."""
    layout = layout_of(tags, tag_id)
    design = np.column_stack(
        [cell_positions(tags, layout.cells), symbol_angles(tags, layout.symbols)]
    )
    _check_observed(tag_id, layout, passes)
    median = _average(design, passes, lambda shapes: np.nanmedian(shapes, axis=0))
    is_consistent = _are_consistent(median, passes)
    kept = [each for each, ok in zip(passes, is_consistent, strict=True) if ok]
    if len(kept) < MIN_PASSES:
        names = ", ".join(each.name for each in passes)
        raise InputError(f"the passes over tag {tag_id} all disagree: {names}")
    _check_observed(tag_id, layout, kept)
    # The scatter of the passes counts besides their own standard deviations.
    deviation = _align_all(kept, median) - median
    spread = np.maximum(np.sqrt(np.nanmean(deviation**2, axis=(0, 1))), MIN_SPREAD)
    own_sigma = np.nan_to_num(np.array([each.sigma for each in kept]))
    weight = 1 / (own_sigma**2 + spread**2)

    def weighted_mean(shapes: Array) -> Array:
        used = np.where(np.isfinite(shapes), weight, 0.0)
        return np.asarray(np.nansum(used * shapes, axis=0) / used.sum(axis=0))

    mean = _average(design, kept, weighted_mean)
    shapes = _align_all(kept, mean)
    count = np.isfinite(shapes[:, :, 0]).sum(axis=0)
    # Each pass took part in the mean: the scatter about it is too small by one degree of freedom.
    scatter = np.sqrt(np.nanmean((shapes - mean) ** 2, axis=0) * (count / (count - 1))[:, None])
    stretch = np.array([_stretch(each, design) for each in kept])
    return AsBuiltReport(
        tag_id=tag_id,
        built=AsBuiltTag(
            mean[:, :2] - design[:, :2], wrap_angle(mean[:, 2] - design[:, 2]), len(kept)
        ),
        scatter_m=np.hypot(scatter[:, 0], scatter[:, 1]),
        scatter_rad=scatter[:, 2],
        passes=count,
        used=tuple(each.name for each in kept),
        disagree=tuple(p.name for p, ok in zip(passes, is_consistent, strict=True) if not ok),
        stretch=float(stretch.mean()),
        sigma_stretch=float(stretch.std(ddof=1) / math.sqrt(len(kept))),
    )


def _check_observed(tag_id: int, layout: TagLayout, passes: Sequence[TagPass]) -> None:
    """Raise an error if a magnet was observed in too few passes."""
    count = np.sum([np.isfinite(each.observed[:, 0]) for each in passes], axis=0)
    if (count < MIN_PASSES).any():
        cell = layout.cells[int(np.argmin(count))]
        raise InputError(
            f"the magnet on cell {cell} of tag {tag_id} was observed {count.min()} times, which "
            f"is less than {MIN_PASSES}",
            hint="Pass the tag again, with the bar over all of it",
        )


def _are_consistent(median: Array, passes: Sequence[TagPass]) -> NDArray[np.bool_]:
    """Return which passes agree with ``median``; of two passes, both do."""
    if len(passes) <= MIN_PASSES:
        return np.ones(len(passes), bool)
    deviation = np.sqrt(np.nanmean((_align_all(passes, median) - median) ** 2, axis=1))
    limit = OUTLIER_RATIO * np.maximum(np.median(deviation, axis=0), MIN_SPREAD)
    return np.asarray((deviation <= limit).all(axis=1))


def _average(design: Array, passes: Sequence[TagPass], average: Callable[[Array], Array]) -> Array:
    """Return the average (M, 3) of passes that are aligned with it, aligned with the design."""
    shape = design
    for _ in range(MAX_ALIGNMENT_ROUNDS):
        before, shape = shape, _align(average(_align_all(passes, shape)), design)
        if np.abs(shape - before).max() < ALIGNMENT_TOLERANCE:
            break
    return shape


def _align_all(passes: Sequence[TagPass], target: Array) -> Array:
    """Return the shapes (n, M, 3) of passes, each aligned with ``target``."""
    return np.array([_align(each.observed, target) for each in passes])


def _align(shape: Array, target: Array) -> Array:
    """Return a shape (M, 3) after the rigid motion that brings it closest to ``target``."""
    motion = _rigid_motion(shape, target)
    rotation = math.atan2(motion.rotation[1, 0], motion.rotation[0, 0])
    angle = target[:, 2] + wrap_angle(shape[:, 2] + rotation - target[:, 2])
    return np.column_stack([motion.apply(shape[:, :2]), angle])


def _rigid_motion(shape: Array, target: Array) -> Similarity:
    """Estimate the rigid motion from the observed magnets of ``shape`` (M, 3) to ``target``."""
    is_observed = np.isfinite(shape[:, 0])
    return umeyama(shape[is_observed, :2], target[is_observed, :2], with_scale=False)


def _stretch(each: TagPass, design: Array) -> float:
    """Return the length of a pass along the track, its x, relative to that of the design."""
    is_observed = np.isfinite(each.observed[:, 0])
    # Direction of the pass's x axis in the tag's frame.
    track = _rigid_motion(each.observed, design).rotation[:, 0]
    along = design[is_observed, :2] @ track
    along -= along.mean()
    return float(along @ each.observed[is_observed, 0] / (along @ along))


def _notes(tags: Tags, report: AsBuiltReport) -> list[str]:
    """Return remarks on a calibrated tag that its user should check."""
    notes, tag = [], f"tag {report.tag_id}"
    excess = report.stretch - 1
    if abs(excess) > max(MIN_REPORTED_STRETCH, 3 * report.sigma_stretch):
        notes.append(
            f"{tag} is {100 * abs(excess):.1f} % {'longer' if excess > 0 else 'shorter'} along the "
            "travel than designed: if it was not built so, the speed is inaccurate"
        )
    limit = tags.step_rad / 4
    size = np.abs(report.built.angle_rad)
    if (size > limit).any():
        cell = layout_of(tags, report.tag_id).cells[int(np.argmax(size))]
        notes.append(
            f"{tag}: the magnet on cell {cell} is {math.degrees(size.max()):.1f} degrees off, more "
            f"than half of the {2 * math.degrees(limit):.4g} degrees at which it would be misread: "
            "rotate it, or solve with this file (--artifact)"
        )
    if report.scatter_rad.max() > limit or report.scatter_m.max() > tags.spacing_m / 10:
        notes.append(
            f"{tag}: passes scatter by up to {1e3 * report.scatter_m.max():.2g} mm and "
            f"{math.degrees(report.scatter_rad.max()):.2g} degrees: check what was different"
        )
    return notes
