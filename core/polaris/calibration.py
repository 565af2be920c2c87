"""How the magnets of a tag really lie, from several passes over it.

Tags that people build have magnets that are off by degrees and tenths of millimetres, the
same ones in every pass (facts 1: 6 degrees rms). Each pass measures all magnets in a frame
of its own; passes are laid over each other, and their mean over the nominal grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.tag import AsBuiltTag, TagLayout, Tags, angles, places

Array = NDArray[np.float64]

LEAST_PASSES = 2

STRAYS = 4.0
"""A pass disagrees where it is so many times further from the others than is usual."""

LEAST_SPREAD = np.array([50e-6, 50e-6, math.radians(0.1)])
"""Of x, y and angle: passes are never taken to agree better."""

LEAST_MAGNETS = 3
"""Of a pass that is used: two places make no shape."""

ROUNDS, CLOSE = 50, 1e-10
"""Most rounds of laying over and averaging, and the change in m and rad that ends them."""

STRETCHED = 0.01
"""What is stretched by less is not worth a word."""


@dataclass(frozen=True)
class Pass:
    """The magnets of one tag as one pass saw them, in the order of the tag's layout.

    Attributes
    ----------
    name : str
        For people: which pass.
    tag_id : int
    seen : (M, 3) ndarray
        x and y in m and angle in rad of each magnet, in any frame of the pass; ``nan`` where
        it was not seen.
    sigma : (M, 3) ndarray
        Their standard deviations; ``nan`` where unknown.
    """

    name: str
    tag_id: int
    seen: Array
    sigma: Array


@dataclass(frozen=True)
class TagReport:
    """What the passes over one tag have told.

    Attributes
    ----------
    tag_id : int
    built : AsBuilt
    scatter_m, scatter_rad : (M,) ndarray
        Rms of the passes about each magnet's mean: of the place in the plane, and of the
        angle.
    passes : (M,) ndarray of int
        How many passes saw each magnet and were used.
    used, disagree : tuple of str
        Names of passes.
    stretch : float
        Length of the tag along the travel over its design; the passes' mean.
    sigma_stretch : float
        Of that mean, from the passes.
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
class CalibrationReport:
    """Tags with what was learned of them.

    Attributes
    ----------
    tags : Tags
        As given, but for ``built`` of the tags in ``found``.
    found : tuple of TagReport
        By id.
    left_out : dict of str to str
        Name of a pass to why it was not used.
    notes : tuple of str
    """

    tags: Tags
    found: tuple[TagReport, ...]
    left_out: dict[str, str]
    notes: tuple[str, ...]


def pass_of(tags: Tags, detection: TagDetection, name: str) -> Pass | str:
    """A detection of a solution as a pass, or why it is none."""
    tag_id = detection.tag_id
    if tag_id is None:
        return f"not read: {detection.refused or 'no reason given'}".replace("_", " ")
    cells = layout_of(tags, tag_id).cells
    seen, sigma = np.full((2, len(cells), 3), np.nan)
    for magnet in detection.magnets:
        if magnet.cell is None or magnet.cell not in cells:
            continue
        number = cells.index(magnet.cell)
        seen[number] = magnet.x_m, magnet.y_m, magnet.angle_rad
        sigma[number] = magnet.sigma_x_m, magnet.sigma_y_m, magnet.sigma_angle_rad
    count = int(np.isfinite(seen[:, 0]).sum())
    if count < LEAST_MAGNETS:
        return f"only {count} magnets were seen"
    return Pass(name, int(tag_id), seen, sigma)


def calibrate(
    tags: Tags, passes: Sequence[Pass], left_out: Mapping[str, str] | None = None
) -> CalibrationReport:
    """Fit the magnets of each tag that was passed at least twice.

    Passes are laid over each other as rigid shapes, and averaged with weights from their
    own standard deviations and from how much they scatter. The mean is laid over the nominal
    grid by least squares over all magnets, so that it says nothing of where the tag as a
    whole lies. Of three passes or more, one that disagrees with the others is left out and
    named. ``left_out`` are passes that are none already: name to why.

    Raises
    ------
    InputError
        No tag was passed twice; a magnet of a tag was seen less than twice; or the passes
        over a tag all disagree.
    """
    by_tag: dict[int, list[Pass]] = {}
    for each in passes:
        by_tag.setdefault(each.tag_id, []).append(each)
    reasons, found = dict(left_out or {}), []
    for tag_id, mine in sorted(by_tag.items()):
        if len(mine) < LEAST_PASSES:
            reasons |= {each.name: f"the only one over tag {tag_id}" for each in mine}
            continue
        report = _tag_report(tags, tag_id, mine)
        reasons |= dict.fromkeys(report.disagree, f"disagrees on tag {tag_id} with the others")
        found.append(report)
    if not found:
        said = "; ".join(f"{name}: {why}" for name, why in reasons.items())
        raise InputError(
            f"no tag was read in {LEAST_PASSES} passes ({said or 'there is no pass'})",
            hint="Pass each tag at least twice, better ten times",
        )
    built = {**tags.built, **{report.tag_id: report.built for report in found}}
    notes = tuple(note for report in found for note in _notes(tags, report))
    return CalibrationReport(replace(tags, built=built), tuple(found), reasons, notes)


def _tag_report(tags: Tags, tag_id: int, passes: Sequence[Pass]) -> TagReport:
    layout = layout_of(tags, tag_id)
    design = np.column_stack([places(tags, layout.cells), angles(tags, layout.symbols)])
    _check_seen(tag_id, layout, passes)
    middle = _centre(design, passes, lambda shapes: np.nanmedian(shapes, axis=0))
    agrees = _agree(middle, passes)
    kept = [each for each, good in zip(passes, agrees, strict=True) if good]
    if len(kept) < LEAST_PASSES:
        names = ", ".join(each.name for each in passes)
        raise InputError(f"the passes over tag {tag_id} all disagree: {names}")
    _check_seen(tag_id, layout, kept)
    # How well passes agree counts beside what each says of itself.
    spread = np.maximum(_rms(_shapes(kept, middle) - middle, axis=(0, 1)), LEAST_SPREAD)
    own = np.nan_to_num(np.array([each.sigma for each in kept]))
    weight = 1 / (own**2 + spread**2)
    mean = _centre(design, kept, lambda shapes: _weighted_mean(shapes, weight))
    shapes = _shapes(kept, mean)
    count = np.isfinite(shapes[:, :, 0]).sum(axis=0)
    # Each pass took part in the mean from which it is measured.
    scatter = _rms(shapes - mean, axis=0) * np.sqrt(count / (count - 1))[:, None]
    stretch = np.array([_stretch(each, design) for each in kept])
    return TagReport(
        tag_id=tag_id,
        built=AsBuiltTag(
            mean[:, :2] - design[:, :2], _wrapped(mean[:, 2] - design[:, 2]), len(kept)
        ),
        scatter_m=np.hypot(scatter[:, 0], scatter[:, 1]),
        scatter_rad=scatter[:, 2],
        passes=count,
        used=tuple(each.name for each in kept),
        disagree=tuple(p.name for p, good in zip(passes, agrees, strict=True) if not good),
        stretch=float(stretch.mean()),
        sigma_stretch=float(stretch.std(ddof=1) / math.sqrt(len(kept))),
    )


def _check_seen(tag_id: int, layout: TagLayout, passes: Sequence[Pass]) -> None:
    count = np.sum([np.isfinite(each.seen[:, 0]) for each in passes], axis=0)
    if (count < LEAST_PASSES).any():
        cell = layout.cells[int(np.argmin(count))]
        raise InputError(
            f"the magnet on cell {cell} of tag {tag_id} was seen {count.min()} times, which is "
            f"less than {LEAST_PASSES}",
            hint="Pass the tag again, with the bar over all of it",
        )


def _agree(middle: Array, passes: Sequence[Pass]) -> NDArray[np.bool_]:
    """Which passes are not much further from ``middle`` than is usual; of two, both."""
    if len(passes) <= LEAST_PASSES:
        return np.ones(len(passes), bool)
    away = _rms(_shapes(passes, middle) - middle, axis=1)
    limit = STRAYS * np.maximum(np.median(away, axis=0), LEAST_SPREAD)
    return np.asarray((away <= limit).all(axis=1))


def _centre(design: Array, passes: Sequence[Pass], average: Callable[[Array], Array]) -> Array:
    """Average (M, 3) of passes that are laid over it, itself laid over ``design``."""
    centre = design
    for _ in range(ROUNDS):
        before, centre = centre, _laid(average(_shapes(passes, centre)), design)
        if np.abs(centre - before).max() < CLOSE:
            break
    return centre


def _shapes(passes: Sequence[Pass], onto: Array) -> Array:
    """Passes (n, M, 3), each laid over ``onto``."""
    return np.array([_laid(each.seen, onto) for each in passes])


def _laid(shape: Array, onto: Array) -> Array:
    """``shape`` moved and turned in the plane over ``onto``, by least squares over the places
    of the magnets that it has; both (M, 3)."""
    turn, moved = _turned(shape, onto)
    angle = onto[:, 2] + _wrapped(shape[:, 2] + turn - onto[:, 2])
    return np.column_stack([moved, angle])


def _turned(shape: Array, onto: Array) -> tuple[float, Array]:
    """The turn in rad, and the places (M, 2) after it."""
    seen = np.isfinite(shape[:, 0])
    # In the plane a turn is a factor: that of the sum of conjugate products.
    a, b = (each[:, 0] + 1j * each[:, 1] for each in (shape, onto))
    middle_a, middle_b = a[seen].mean(), b[seen].mean()
    factor = np.vdot(a[seen] - middle_a, b[seen] - middle_b)
    moved = (a - middle_a) * factor / abs(factor) + middle_b
    return float(np.angle(factor)), np.column_stack([moved.real, moved.imag])


def _stretch(each: Pass, design: Array) -> float:
    """Length along the travel, the x of the pass, over that of the design."""
    turn, _ = _turned(each.seen, design)
    seen = np.isfinite(each.seen[:, 0])
    along = (design[:, :2] @ [math.cos(turn), math.sin(turn)])[seen]
    along -= along.mean()
    return float(along @ each.seen[seen, 0] / (along @ along))


def _notes(tags: Tags, report: TagReport) -> list[str]:
    notes, tag = [], f"tag {report.tag_id}"
    off = report.stretch - 1
    if abs(off) > max(STRETCHED, 3 * report.sigma_stretch):
        notes.append(
            f"{tag} is {100 * abs(off):.1f} % {'longer' if off > 0 else 'shorter'} along the "
            "travel than it was designed: if it was not built so, the speed is not known well "
            "enough"
        )
    limit = tags.step_rad / 4
    if (np.abs(report.built.angle_rad) > limit).any():
        cell = layout_of(tags, report.tag_id).cells[int(np.argmax(np.abs(report.built.angle_rad)))]
        worst = math.degrees(np.abs(report.built.angle_rad).max())
        notes.append(
            f"{tag}: the magnet on cell {cell} is {worst:.1f} degrees off, more than half of "
            f"the {2 * math.degrees(limit):.4g} degrees at which it would be misread: turn it, or "
            "solve with this file (--artifact)"
        )
    if report.scatter_rad.max() > limit or report.scatter_m.max() > tags.spacing_m / 10:
        notes.append(
            f"{tag}: passes scatter by up to {1e3 * report.scatter_m.max():.2g} mm and "
            f"{math.degrees(report.scatter_rad.max()):.2g} degrees: look what was different"
        )
    return notes


def _weighted_mean(shapes: Array, weight: Array) -> Array:
    weight = np.where(np.isfinite(shapes), weight, 0.0)
    return np.asarray((weight * np.nan_to_num(shapes)).sum(axis=0) / weight.sum(axis=0))


def _rms(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Over what is there."""
    return np.asarray(np.sqrt(np.nanmean(values**2, axis=axis)))


def _wrapped(angle: Array) -> Array:
    """Within -pi to pi."""
    return np.asarray((angle + math.pi) % math.tau - math.pi)
