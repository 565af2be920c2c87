"""How long alignment by DDTW takes, and template sets, beside what others offer for it."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.polaris.published import ddtw
from locatk.core.polaris.published.cylinders import cylinder_fields
from locatk.core.polaris.published.templates import (
    TemplateGrid,
    dipole_fields,
    template_set,
)
from locatk.core.polaris.tag import Tags
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.timing import SEED, alone, cpu_seconds, measured

Array = NDArray[np.float64]

SETS = {180: (2.0, 5.0), 1800: (20.0, 30.0)}
"""Templates to the milliseconds promised for aligning a window with them all, and for making
them."""

ALIGNED = {
    180: ("authors' ddtw.c on a like machine; 29.4 on a Jetson Nano", 16.0),
    1800: ("paper, on a Jetson Nano", 350.2),
}
MADE = {
    180: ("magpylib's cylinders, one call", 13.7),
    1800: ("magpylib's cylinders, one call", 124.0),
}
"""Milliseconds of others: the paper's figures, and magpylib and the authors' code
(github.com/wjk5117/Polaris) as measured before the project."""

KERNEL = "numpy, no compiled kernel" if kernels is None else "compiled kernel"

PEERS = ("aeon", "dtaidistance", "tslearn")


def speed_figures() -> list[Figure]:
    """All figures of speed but that of a run."""
    rows = []
    for count, (align_ms, make_ms) in SETS.items():
        name = f"{count:,} templates of {TemplateGrid.points} samples"
        peer, peer_ms = ALIGNED[count]
        rows.append(
            measured(f"DDTW, {name}", "ms", f"polaris.speed.aligning({count})", 1e3,
                     f"distances() of one window of {TemplateGrid.points} x 3 samples to slopes "
                     f"that are ready, one thread, best of 20; {KERNEL}", align_ms,
                     peer=peer, peer_value=peer_ms)
        )  # fmt: skip
        rows += [_beside(peer, count) for peer in PEERS]
        peer, peer_ms = MADE[count]
        rows += [
            measured(f"{name} made", "ms", f"polaris.speed.making({count})", 1e3,
                     "template_set(): dipoles, one thread, best of 20", make_ms,
                     peer=peer, peer_value=peer_ms),
            measured(f"{name} made, cylinders", "ms", f"polaris.speed.making({count}, 'cylinder')",
                     1e3, "template_set(): magpylib's cylinders, one thread, best of 20",
                     None, peer=peer, peer_value=peer_ms),
        ]  # fmt: skip
    return rows


def _beside(peer: str, count: int) -> Figure:
    """Our time in one process with that of a library, where that is installed."""
    name = f"DDTW, {count:,} templates, in one run with {peer}"
    try:
        label = f"{peer} {version(peer)}"
        ours, theirs = alone(f"polaris.speed.aligning({count}, {peer!r})")
    except PackageNotFoundError:
        return Figure(name, None, "ms", "not installed", peer=peer)
    except OSError as error:
        return Figure(name, None, "ms", f"not measured: {error}", peer=peer)
    how = f"{theirs / ours:.0f} times as fast; the same window and templates, one thread"
    return Figure(name, 1e3 * ours, "ms", how, peer=label, peer_value=1e3 * theirs)


def window_and_templates(count: int) -> tuple[Array, Array]:
    """A window (n, 3) in noise, and ``count`` templates (N, n, 3)."""
    field = template_set(*_design(count)).field_t
    rng = np.random.default_rng(SEED)
    return field[count // 3] + rng.normal(0, 0.5e-6, field.shape[1:]), field


def aligning(count: int, peer: str = "") -> tuple[float, ...]:
    """Seconds to align one window with ``count`` templates: ours, and those of a peer."""
    window, field = window_and_templates(count)
    slopes = ddtw.prepare(field)
    ours = cpu_seconds(lambda: ddtw.distances(window, slopes), 20)
    if not peer:
        return (ours,)
    call = _CALLS[peer](window, field)
    call()  # what is compiled when it is first called is not counted
    return ours, cpu_seconds(call, 3)


def _aeon(window: Array, field: Array) -> Callable[[], object]:
    distance = import_module("aeon.distances").ddtw_pairwise_distance
    query, others = (np.ascontiguousarray(part.swapaxes(-1, -2)) for part in (window[None], field))
    return lambda: distance(query, others)


def _dtaidistance(window: Array, field: Array) -> Callable[[], object]:
    distance = import_module("dtaidistance.dtw_ndim").distance_fast
    query, others = ddtw.normalised_slopes(window), list(ddtw.normalised_slopes(field))
    return lambda: [distance(query, other) for other in others]


def _tslearn(window: Array, field: Array) -> Callable[[], object]:
    distance = import_module("tslearn.metrics").cdist_dtw
    query, others = ddtw.normalised_slopes(window)[None], ddtw.normalised_slopes(field)
    return lambda: distance(query, others)


_CALLS: dict[str, Callable[[Array, Array], Callable[[], object]]] = {
    "aeon": _aeon,
    "dtaidistance": _dtaidistance,
    "tslearn": _tslearn,
}
"""aeon takes derivatives itself; the others are given ours, which they are not charged for."""


def making(count: int, model: str = "dipole") -> tuple[float]:
    """Seconds to make a template set of the default tag."""
    fields = dipole_fields if model == "dipole" else cylinder_fields
    return (cpu_seconds(lambda: template_set(*_design(count), fields), 20),)


def _design(count: int) -> tuple[Tags, float, TemplateGrid]:
    """Return the default tag, the largest lateral offset of its array, and the grid of a set."""
    tags = Tags()
    return tags, tags.spacing_m / 4, TemplateGrid(orientations=count // TemplateGrid.offsets)
