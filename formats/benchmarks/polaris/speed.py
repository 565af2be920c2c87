"""Duration of alignment by DDTW and of template sets, compared with other libraries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

import magpylib
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
from locatk.formats.benchmarks.figures import Duration, Figure
from locatk.formats.benchmarks.timing import (
    FIRST_SEED,
    measure_single_threaded,
    run_single_threaded,
    time_call,
)

Array = NDArray[np.float64]

TARGETS_MS = {180: (2.0, 5.0), 1800: (20.0, 30.0)}
"""Number of templates to the targets of aligning a window with all of them, and of computing
them."""

ALIGNMENT_PEERS_MS = {
    180: ("authors' ddtw.c on a like machine; 29.4 on a Jetson Nano", 16.0),
    1800: ("paper, on a Jetson Nano", 350.2),
}
"""Durations of other software: the paper, and the authors' code (github.com/wjk5117/Polaris),
measured before the project."""

MAGPYLIB = "magpylib's cylinders, one call"

KERNEL = "numpy, no compiled kernel" if kernels is None else "compiled kernel"

LIBRARIES = ("aeon", "dtaidistance", "tslearn")


def speed_figures() -> list[Figure]:
    """Return all figures of speed except the duration of a run."""
    rows = []
    for count, (align_ms, template_ms) in TARGETS_MS.items():
        name = f"{count:,} templates of {TemplateGrid.points} samples"
        peer, peer_ms = ALIGNMENT_PEERS_MS[count]
        alignment = Figure(
            f"DDTW, {name}", None, "ms",
            f"distances() of one window of {TemplateGrid.points} x 3 samples to given slopes, "
            f"processor time of one thread, best of 20; {KERNEL}", align_ms, peer=peer,
            peer_value=peer_ms, workload="numpy",
        )  # fmt: skip
        rows.append(
            measure_single_threaded(alignment, f"polaris.speed.time_alignment({count})", 1e3)
        )
        rows += [_compare_library(peer, count) for peer in LIBRARIES]
        for label, fields, field_name, target in (
            ("", "dipole", "dipoles", template_ms),
            (", cylinders", "cylinder", "magpylib's cylinders", None),
        ):
            templates = Figure(
                f"{name} made{label}", None, "ms",
                f"template_set(): {field_name}, processor time of one thread, best of 20; the "
                "peer in the same run", target, peer=MAGPYLIB, workload="numpy",
            )  # fmt: skip
            try:
                magpylib_s, *duration = run_single_threaded(
                    f"polaris.speed.time_templates({count}, {fields!r})"
                )
            except OSError as error:
                rows.append(templates.missing(error))
                continue
            compared = replace(templates, peer_value=1e3 * magpylib_s)
            rows.append(compared.timed(Duration(*duration), 1e3))
    return rows


def _compare_library(peer: str, count: int) -> Figure:
    """Time our alignment and that of a library in one process, if the library is installed."""
    figure = Figure(
        f"DDTW, {count:,} templates, in one run with {peer}", None, "ms", "not installed",
        peer=peer, workload="numpy",
    )  # fmt: skip
    try:
        label = f"{peer} {version(peer)}"
        ours_s, factor, peer_s, _ = run_single_threaded(
            f"polaris.speed.time_alignment({count}, {peer!r})"
        )
    except PackageNotFoundError:
        return figure
    except OSError as error:
        return figure.missing(error)
    how = f"{peer_s / ours_s:.0f} times as fast; the same window and templates, one thread"
    compared = replace(figure, how=how, peer=label, peer_value=1e3 * peer_s)
    return compared.timed(Duration(ours_s, factor), 1e3)


def window_and_templates(count: int) -> tuple[Array, Array]:
    """Return a window (n, 3) with noise, and ``count`` templates (N, n, 3)."""
    field = template_set(*_template_design(count)).field_t
    rng = np.random.default_rng(FIRST_SEED)
    return field[count // 3] + rng.normal(0, 0.5e-6, field.shape[1:]), field


def time_alignment(count: int, peer: str = "") -> tuple[float, ...]:
    """Time the alignment of one window with ``count`` templates, and that of a peer after it."""
    window, field = window_and_templates(count)
    slopes = ddtw.prepare(field)
    duration = time_call(lambda: ddtw.distances(window, slopes), 20)
    if not peer:
        return duration
    call = PEER_CALLS[peer](window, field)
    call()  # compilation at the first call is not counted
    return *duration, *time_call(call, 3)


def _aeon(window: Array, field: Array) -> Callable[[], object]:
    distance = import_module("aeon.distances").ddtw_pairwise_distance
    query, templates = (
        np.ascontiguousarray(part.swapaxes(-1, -2)) for part in (window[None], field)
    )
    return lambda: distance(query, templates)


def _dtaidistance(window: Array, field: Array) -> Callable[[], object]:
    distance = import_module("dtaidistance.dtw_ndim").distance_fast
    query, templates = ddtw.normalised_slopes(window), list(ddtw.normalised_slopes(field))
    return lambda: [distance(query, template) for template in templates]


def _tslearn(window: Array, field: Array) -> Callable[[], object]:
    distance = import_module("tslearn.metrics").cdist_dtw
    query, templates = ddtw.normalised_slopes(window)[None], ddtw.normalised_slopes(field)
    return lambda: distance(query, templates)


PEER_CALLS: dict[str, Callable[[Array, Array], Callable[[], object]]] = {
    "aeon": _aeon,
    "dtaidistance": _dtaidistance,
    "tslearn": _tslearn,
}
"""Alignment of a window with templates by each library. aeon computes derivatives itself; the
others receive ours, whose duration is not counted."""


def time_templates(count: int, model: str = "dipole") -> tuple[float, float, float]:
    """Time the computation of a template set of the default tag.

    Returns the duration of magpylib [s] for as many cylinders at as many points, in one call, and
    the duration and the machine factor of the set.
    """
    fields = dipole_fields if model == "dipole" else cylinder_fields
    design = _template_design(count)
    tags, max_offset_m, grid = design
    magnet = tags.magnet
    cylinder = magpylib.magnet.Cylinder(
        dimension=(magnet.diameter_m, magnet.height_m), polarization=(magnet.remanence_t, 0, 0)
    )
    cylinders = [cylinder.copy() for _ in range(count)]
    x_m = np.linspace(-tags.spacing_m, tags.spacing_m, grid.points)
    points_m = np.column_stack([x_m, np.full_like(x_m, max_offset_m), np.full_like(x_m, 0.01)])
    by_magpylib = time_call(lambda: magpylib.getB(cylinders, points_m), 3)
    duration = time_call(lambda: template_set(*design, fields), 20)
    return by_magpylib.seconds, *duration


def _template_design(count: int) -> tuple[Tags, float, TemplateGrid]:
    """Return the default tag, the largest lateral offset of its array, and the grid of a set."""
    tags = Tags()
    return tags, tags.spacing_m / 4, TemplateGrid(orientations=count // TemplateGrid.offsets)
