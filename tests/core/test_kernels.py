"""Checks of the arguments of all compiled kernels: inconsistent calls raise and never crash."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.kernels import kernels

pytestmark = pytest.mark.skipif(
    kernels is None, reason="the compiled kernels were not built (no C compiler)"
)

Arguments = dict[str, Any]
Array = NDArray[Any]

SEQUENCE_LENGTH = 131071
"""States of a 17-bit shift register of Lighthouse."""


def random() -> np.random.Generator:
    return np.random.default_rng(1)


def floats(*shape: int) -> Array:
    return random().normal(size=shape).astype(np.float32)


def doubles(*shape: int) -> Array:
    return random().normal(size=shape)


def find_dots() -> Arguments:
    n, height, width, max_dots = 2, 12, 17, 6
    return {
        "images": random().integers(0, 256, (n, height, width)).astype(np.uint8),
        "n": n,
        "height": height,
        "width": width,
        "taps": np.array([0.1, 0.2, 0.4], np.float32),
        "block": 4,
        "window": 7,
        "slope_reach": 3,
        "max_slope": 0.1,
        "min_contrast": 1.5,
        "contrast_fraction": 0.45,
        "min_dots": 2,
        "splits": 3,
        "max_dots": max_dots,
        "xy": np.zeros((n, max_dots, 2), np.float32),
        "counts": np.zeros(n, np.int64),
    }


def lattice_points(n: int) -> Array:
    """(n, 36, 2) points of a square lattice of pitch 0.1 with small errors."""
    cells = np.stack(np.meshgrid(np.arange(-3, 3), np.arange(-3, 3)), -1).reshape(-1, 2)
    scatter = random().normal(scale=0.003, size=(n, len(cells), 2))
    return np.asarray((0.1 * cells + scatter), np.float32)


def fit_lattices() -> Arguments:
    points = lattice_points(2)
    n, m = points.shape[:2]
    return {
        "points": points,
        "valid": np.ones((n, m), bool),
        "n": n,
        "m": m,
        "lens": True,
        "is_thorough": True,
        "passes": 1,
        "ring_radii": np.array([3.2, 6.0]),
        "prior": np.full(9, 1.0),
        "seeds": 20,
        "min_dots": 10,
        "min_sigmas": 5.0,
        "min_neighbour": 0.36,
        "max_neighbour": 1.32,
        "cell_gate": 0.36,
        "cell_sigma": 0.12,
        "symbol_gate": 0.12,
        "symbol_sigma": 0.03,
        "lens_radius": 4.0,
        "offset": 1 / 6,
        "min_seed_power": 0.2,
        "parameters": np.zeros((n, 9)),
        "uv": np.zeros((n, m, 2), np.float32),
        "cells": np.zeros((n, m, 2), np.float32),
        "sigma": np.zeros(n),
        "found": np.zeros(n, bool),
    }


def lattice_coordinates(n: int) -> tuple[Array, Array]:
    """(n, 36, 2) lattice coordinates of dots, and the same rounded to cells."""
    cells = np.rint(10 * lattice_points(n)).astype(np.float32)
    return cells + random().uniform(-0.2, 0.2, cells.shape).astype(np.float32), cells


def soft_bits() -> Arguments:
    uv, cells = lattice_coordinates(2)
    n, m = cells.shape[:2]
    half_width = 4
    return {
        "uv": uv,
        "cells": cells,
        "valid": np.ones((n, m), bool),
        "found": np.ones(n, bool),
        "sigma": np.full(n, 0.03),
        "n": n,
        "m": m,
        "half_width": half_width,
        "offset": 1 / 6,
        "symbol_gate": 0.12,
        "wrong_symbol": 0.002,
        "x_bits": np.zeros((n, 2 * half_width, 2 * half_width), np.float32),
        "y_bits": np.zeros((n, 2 * half_width, 2 * half_width), np.float32),
    }


def codec(length: int) -> Arguments:
    """A codec with short sequences, for windows of ``length`` cells a side."""
    lengths = np.array([5, 7, 3, 4])
    positions = int(lengths.prod())
    prefixes = [np.arange(k + 1) for k in lengths]
    crt = [positions // int(k) * pow(positions // int(k), -1, int(k)) for k in lengths]
    widest = 2 * int(lengths.max()) - 1
    return {
        "lengths": lengths,
        "weights": np.array([1, 3, 9, 18]),
        "prefixes": np.concatenate(prefixes),
        "crt": np.array(crt) % positions,
        "signs": np.sign(floats(length + 62)),
        "digits": random().integers(-1, 3, (4, 63)).astype(np.int8),
        "masks": random().integers(0, 2, (4, 3, widest)).astype(np.float32),
        "range": positions,
        "smallest_shift": 5,
    }


def read_windows() -> Arguments:
    n, length = 2, 6
    return {
        "x_bits": floats(n, length, length),
        "y_bits": floats(n, length, length),
        "n": n,
        "length": length,
        **codec(length),
        "log_hypotheses": 10.0,
        "positions": np.zeros((n, 11), np.int64),
        "evidence": np.zeros((n, 6)),
    }


def search_positions() -> Arguments:
    n, length = 2, 6
    return {
        "scores": floats(n, length, 63),
        "n": n,
        "length": length,
        **codec(length),
        "beam_width": 7,
        "misread": 3,
        "ranks": 2,
        "min_probability": 1e-4,
        "positions": np.zeros((n, 2), np.int64),
        "rivals": np.zeros(n),
    }


def poses() -> Arguments:
    points = lattice_points(2)
    n, m = points.shape[:2]
    half_width = 4
    windows = np.array([[10, 20, 3, 4, 0], [-5, 400, 62, 0, 3]])
    return {
        "points": points,
        "valid": np.ones((n, m), bool),
        "n": n,
        "m": m,
        "half_width": half_width,
        "lens": False,
        "prior": np.full(9, 1.0),
        "windows": windows,
        **codec(2 * half_width),
        "offset": 1 / 6,
        "symbol_gate": 0.5,
        "min_sigma": 0.001,
        "max_steps": 3,
        "fitted_parameters": 8,
        "higher_lens_sigma": 0.15,
        "higher_lens_odds": 25.0,
        "gate_sigmas": 3.0,
        "gated_variance": 0.95,
        "square_radius": 0.0174,
        "square_radius_sigma": 0.007,
        "parameters": np.tile([10.0, 0, 0, 0, 10.0, 0, 0, 0, 0], (n, 1)),
        "pose": np.zeros((n, 3)),
        "covariance": np.zeros((n, 3, 3)),
    }


def ddtw() -> Arguments:
    n, length, count = 4, 5, 35
    return {
        "query": floats(n, 3),
        "slopes": floats(length, 3, count),
        "n": n,
        "length": length,
        "count": count,
        "cost": np.zeros(count, np.float32),
    }


def bar_fields() -> Arguments:
    count = 3
    return {
        "points": doubles(count, 3),
        "count": count,
        "half_length": 0.02,
        "half_width": 0.005,
        "height": 0.002,
        "radius": 0.05,
        "remanence": 0.4,
        "min_distance": 1e-6,
        "gradient": True,
        "field": np.zeros((count, 4)),
        "slope": np.zeros((count, 4, 3)),
    }


def scan_landmarks() -> Arguments:
    count, n_centres, n_headings, size, n_strengths = 5, 3, 2, 9, 4
    return {
        "points": doubles(count, 2),
        "values": doubles(count),
        "weights": np.ones(count),
        "count": count,
        "centres": doubles(n_centres, 2),
        "n_centres": n_centres,
        "headings": doubles(n_headings),
        "n_headings": n_headings,
        "table": floats(size, size, 4),
        "size": size,
        "step": 0.5,
        "min_gain": 0.8,
        "max_gain": 1.2,
        "strengths": doubles(n_strengths, 4),
        "n_strengths": n_strengths,
        "cost": np.zeros((n_headings, n_centres, n_strengths)),
    }


def search_map() -> Arguments:
    cells, items, length, letters = 5, 5, 2, 2
    item_cells = np.stack([np.arange(items), (np.arange(items) + 1) % cells], axis=1)
    order = np.argsort(item_cells, axis=None, kind="stable")
    values = np.array([0, 1, 1, 0, 1], np.uint8)
    parts = np.array([[0, 1], [0, 2]])
    return {
        "item_cells": item_cells.astype(np.int32),
        "first": np.arange(0, 2 * cells + 1, 2).astype(np.int32),
        "use_item": (order // length).astype(np.int32),
        "use_row": (order % length).astype(np.int32),
        "parts": parts.astype(np.uint64),
        "weights": np.array([100, 50, 10], np.uint32),
        "values": values,
        "words": (values[item_cells] * parts[:, 1]).sum(axis=1).astype(np.uint64),
        "conflicts": np.zeros(1, np.int64),
        "cells": cells,
        "items": items,
        "length": length,
        "letters": letters,
        "n_weights": 3,
        "possible": 4,
        "seed": 7,
        "steps": 100,
    }


def window_edges() -> Arguments:
    rows, width = 3, 11
    return {
        "windows": random().integers(0, 256, (rows, width)).astype(np.uint8),
        "width": width,
        "tick": np.zeros(rows * width * 8, np.int64),
        "first": np.zeros(rows + 1, np.int64),
        "rises": np.zeros(rows, np.uint8),
    }


def light_bits() -> Arguments:
    sizes = np.array([20, 1, 30])
    steps = random().integers(1, 3, sizes.sum()) * 4
    return {
        "tick": np.cumsum(steps),
        "first": np.concatenate([[0], np.cumsum(sizes)]),
        "rises": np.array([1, 0, 1], np.uint8),
        "readable": np.array([1, 0, 1], np.uint8),
        "ticks_per_chip": 4.0,
        "max_chips": 60,
        "value": np.zeros(80, np.int8),
        "value_first": np.zeros(len(sizes) + 1, np.int64),
        "start": np.zeros(len(sizes)),
    }


def sequence_bits() -> Arguments:
    """Soft bits of three bursts."""
    first = np.array([0, 70, 70, 200])
    return {"value": random().integers(-64, 65, 200).astype(np.int8), "first": first}


def light_places() -> Arguments:
    polynomials = 2
    shape = (polynomials, SEQUENCE_LENGTH)
    return {
        **sequence_bits(),
        "states": random().integers(0, SEQUENCE_LENGTH, shape, np.int32),
        "index": np.full((polynomials, SEQUENCE_LENGTH + 1), -1, np.int32),
        "taps": np.array([0x1D258, 0x17E04], np.int32),
        "polynomials": polynomials,
        "match": np.arange(65, dtype=np.int32),
        "miss": -np.arange(65, dtype=np.int32),
        "unknown": 3,
        "min_run": 1,
        "steps": 16,
        "min_evidence": 700,
        "rows": np.zeros((3, 7), np.int32),
    }


def light_expected() -> Arguments:
    polynomials, candidates = 2, 2
    shape = (polynomials, SEQUENCE_LENGTH)
    return {
        **sequence_bits(),
        "states": random().integers(0, SEQUENCE_LENGTH, shape, np.int32),
        "polynomial": np.array([[0, 1], [1, 0], [1, 1]], np.int32),
        "index": np.array([[0, 131070], [5, -7], [10**9, 3]]),
        "candidates": candidates,
        "search_range": 2,
        "match": np.arange(65, dtype=np.int32),
        "miss": -np.arange(65, dtype=np.int32),
        "unknown": 3,
        "rows": np.zeros((3, 7), np.int32),
    }


def light_epochs() -> Arguments:
    n = 9
    return {
        "starts": np.arange(n) % 4 == 0,
        "time_ns": np.cumsum(random().uniform(0, 2e7, n)),
        "planes": random().integers(1, 16, n),
        "n": n,
        "max_epoch_ns": 3e7,
        "epoch": np.full(n, -1, np.int64),
    }


def light_positions() -> Arguments:
    m, s = 5, 3
    return {
        "angle": 0.1 * doubles(m, s, 2),
        "m": m,
        "s": s,
        "stations": doubles(s, 14),
        "floor_z": 0.5,
        "passes": 3,
        "position": np.zeros((m, 3)),
        "information": np.zeros((m, 3, 3)),
        "residual": np.zeros((m, s, 2)),
        "redundancy": np.zeros(m, np.int64),
    }


def solve_band() -> Arguments:
    n, band, m = 12, 4, 35
    factor = 0.1 * doubles(n, band)
    factor[:, 0] = 1.0
    return {
        "factor": factor,
        "n": n,
        "band": band,
        "m": m,
        "is_half": False,
        "solution": doubles(n, m),
    }


def couple_sweeps() -> Arguments:
    n, k, d, width, m = 9, 4, 3, 2, 5
    return {
        "knot": random().integers(0, k - 1, n),
        "jacobian": doubles(n, 2 * d),
        "column": random().integers(0, m, (n, width)),
        "value": doubles(n, width),
        "n": n,
        "k": k,
        "d": d,
        "width": width,
        "m": m,
        "coupling": np.zeros((k, d, m)),
        "information": np.zeros((m, m)),
    }


CASES: dict[str, Callable[[], Arguments]] = {
    case.__name__: case
    for case in (
        find_dots,
        fit_lattices,
        soft_bits,
        read_windows,
        search_positions,
        poses,
        ddtw,
        bar_fields,
        scan_landmarks,
        search_map,
        window_edges,
        light_bits,
        light_places,
        light_expected,
        light_epochs,
        light_positions,
        solve_band,
        couple_sweeps,
    )
}
"""A valid call of each kernel, by the names of its arguments."""

OUTPUTS = {
    "find_dots": ("xy", "counts"),
    "fit_lattices": ("parameters", "uv", "cells", "sigma", "found"),
    "soft_bits": ("x_bits", "y_bits"),
    "read_windows": ("positions", "evidence"),
    "search_positions": ("positions", "rivals"),
    "poses": ("parameters", "pose", "covariance"),
    "ddtw": ("cost",),
    "bar_fields": ("field", "slope"),
    "scan_landmarks": ("cost",),
    "search_map": ("values", "words", "conflicts"),
    "window_edges": ("tick", "first", "rises"),
    "light_bits": ("value", "value_first", "start"),
    "light_places": ("rows",),
    "light_expected": ("rows",),
    "light_epochs": ("epoch",),
    "light_positions": ("position", "information", "residual", "redundancy"),
    "solve_band": ("solution",),
    "couple_sweeps": ("coupling", "information"),
}

ANY_SIZE = {("fit_lattices", "ring_radii"), ("light_bits", "value")}
"""Arrays whose size is free: a list of radii, and the memory for bits, which may not suffice."""

ZERO_IS_VALID = {
    ("find_dots", "min_dots"),
    ("find_dots", "splits"),
    ("read_windows", "smallest_shift"),
    ("poses", "smallest_shift"),
    ("search_positions", "smallest_shift"),
    ("search_positions", "misread"),
    ("search_map", "seed"),
    ("search_map", "steps"),
    ("light_places", "unknown"),
    ("light_places", "steps"),
    ("light_places", "min_evidence"),
    ("light_expected", "unknown"),
    ("light_expected", "search_range"),
}

UPPER_LIMIT = {"min_dots": 2**31, "steps": 2**31, "min_evidence": 2**31, "range": 2**40}
"""Integers that do not denote a size, which are valid up to a limit."""

UNLIMITED = {("search_map", "seed"), ("search_map", "steps")}
"""Integers of 64 bits. A seed is also taken modulo 2^64."""

OTHER_TYPES = {
    "bool": ("int8", "int16"),
    "int8": ("uint8", "int16"),
    "uint8": ("int8", "uint16"),
    "int32": ("float32", "int64"),
    "uint32": ("int32", "uint64"),
    "int64": ("float64", "int32"),
    "uint64": ("int64", "uint32"),
    "float32": ("int32", "float64"),
    "float64": ("int64", "float32"),
}
"""A type of the same size and one of another size."""


def call(kernel: str, arguments: Arguments) -> None:
    assert getattr(kernels, kernel)(*arguments.values()) is None


def select(accept: Callable[[Any], bool]) -> list[tuple[str, str]]:
    """Kernels and names of the arguments that are accepted."""
    return [
        (kernel, name)
        for kernel, case in CASES.items()
        for name, value in case().items()
        if accept(value)
    ]


ARRAYS = select(lambda value: isinstance(value, np.ndarray))
INTEGERS = select(lambda value: isinstance(value, int) and not isinstance(value, bool))
NUMBERS = select(lambda value: isinstance(value, (int, float)) and not isinstance(value, bool))

each_array = pytest.mark.parametrize(("kernel", "name"), ARRAYS)
each_integer = pytest.mark.parametrize(("kernel", "name"), INTEGERS)
each_large_array = pytest.mark.parametrize(
    ("kernel", "name"), select(lambda value: isinstance(value, np.ndarray) and value.size > 1)
)
each_wide_array = pytest.mark.parametrize(
    ("kernel", "name"), select(lambda value: isinstance(value, np.ndarray) and value.itemsize > 1)
)


def test_every_kernel_has_a_case() -> None:
    functions = {name for name, _ in inspect.getmembers(kernels, inspect.isbuiltin)}
    assert functions == set(CASES) == set(OUTPUTS)


@pytest.mark.parametrize("kernel", CASES)
def test_arguments_are_those_of_the_signature(kernel: str) -> None:
    assert list(inspect.signature(getattr(kernels, kernel)).parameters) == list(CASES[kernel]())


@pytest.mark.parametrize("kernel", CASES)
def test_valid_calls_change_only_outputs(kernel: str) -> None:
    arguments, before = CASES[kernel](), CASES[kernel]()
    call(kernel, arguments)
    changed = {
        name
        for name, value in arguments.items()
        if isinstance(value, np.ndarray) and not np.array_equal(value, before[name])
    }
    assert changed
    assert changed <= set(OUTPUTS[kernel])


@pytest.mark.parametrize("change", ["short", "empty"])
@pytest.mark.parametrize(("kernel", "name"), [case for case in ARRAYS if case not in ANY_SIZE])
def test_too_few_items(kernel: str, name: str, change: str) -> None:
    arguments = CASES[kernel]()
    arguments[name] = arguments[name].reshape(-1)[: -1 if change == "short" else 0]
    with pytest.raises(ValueError, match=r"expected|no value is valid"):
        call(kernel, arguments)


@each_array
def test_wrong_item_types(kernel: str, name: str) -> None:
    arguments = CASES[kernel]()
    array = arguments[name]
    with np.errstate(invalid="ignore"):
        others = [array.astype(other) for other in OTHER_TYPES[array.dtype.name]]
    if array.itemsize > 1:
        others.append(array.astype(array.dtype.newbyteorder()))
    for other in others:
        with pytest.raises(ValueError, match=f"^{name} has items of format"):
            call(kernel, {**arguments, name: other})


@each_large_array
def test_arrays_that_are_not_contiguous(kernel: str, name: str) -> None:
    arguments = CASES[kernel]()
    arguments[name] = np.repeat(arguments[name].reshape(-1), 2)[::2]
    with pytest.raises(ValueError, match=f"^{name} is not contiguous"):
        call(kernel, arguments)


@each_wide_array
def test_arrays_that_are_not_aligned(kernel: str, name: str) -> None:
    arguments = CASES[kernel]()
    array = arguments[name]
    shifted = np.zeros(array.nbytes + 1, np.uint8)[1:].view(array.dtype)
    shifted[:] = array.reshape(-1)
    with pytest.raises(ValueError, match=f"^{name} is not aligned"):
        call(kernel, {**arguments, name: shifted})


@pytest.mark.parametrize(
    ("kernel", "name"), [(kernel, name) for kernel, names in OUTPUTS.items() for name in names]
)
def test_read_only_outputs(kernel: str, name: str) -> None:
    arguments = CASES[kernel]()
    arguments[name].flags.writeable = False
    with pytest.raises(ValueError, match=f"^{name} is read-only"):
        call(kernel, arguments)


@each_array
@pytest.mark.parametrize("value", [None, 3, "text", [1.0]])
def test_objects_that_are_no_arrays(kernel: str, name: str, value: object) -> None:
    with pytest.raises(TypeError, match=f"^{name} is no array"):
        call(kernel, {**CASES[kernel](), name: value})


@pytest.mark.parametrize(
    ("kernel", "name", "other"),
    [
        ("fit_lattices", "cells", "uv"),
        ("fit_lattices", "uv", "points"),
        ("soft_bits", "x_bits", "y_bits"),
        ("light_bits", "value_first", "first"),
        ("scan_landmarks", "values", "cost"),
    ],
)
def test_outputs_that_share_memory(kernel: str, name: str, other: str) -> None:
    arguments = CASES[kernel]()
    arguments[name] = arguments[other].reshape(-1)[: arguments[name].size]
    with pytest.raises(ValueError, match="shares memory"):
        call(kernel, arguments)


@pytest.mark.parametrize("value", [-1, -(2**31), -(2**62), -(2**80)])
@pytest.mark.parametrize(
    ("kernel", "name"), [case for case in INTEGERS if case[1] not in {"seed", "min_evidence"}]
)
def test_negative_integers(kernel: str, name: str, value: int) -> None:
    with pytest.raises(ValueError, match=r"expected|outside of 64 bits"):
        call(kernel, {**CASES[kernel](), name: value})


@each_integer
def test_integers_of_zero(kernel: str, name: str) -> None:
    arguments = {**CASES[kernel](), name: 0}
    if (kernel, name) in ZERO_IS_VALID:
        call(kernel, arguments)
    else:
        with pytest.raises(ValueError, match="expected"):
            call(kernel, arguments)


@pytest.mark.parametrize(
    ("kernel", "name", "value"),
    [
        (kernel, name, value)
        for kernel, name in INTEGERS
        for value in (2**31 - 1, 2**31, 2**62, 2**63 - 1, 2**80)
        if (kernel, name) not in UNLIMITED and value >= UPPER_LIMIT.get(name, 0)
    ],
)
def test_integers_that_are_far_too_large(kernel: str, name: str, value: int) -> None:
    with pytest.raises(ValueError, match=r"expected|outside of 64 bits|too large"):
        call(kernel, {**CASES[kernel](), name: value})


@pytest.mark.parametrize(("kernel", "name"), NUMBERS)
def test_numbers_of_another_type(kernel: str, name: str) -> None:
    with pytest.raises(TypeError):
        call(kernel, {**CASES[kernel](), name: "1"})


@pytest.mark.parametrize("kernel", CASES)
def test_a_missing_argument(kernel: str) -> None:
    arguments = CASES[kernel]()
    arguments.popitem()
    with pytest.raises(TypeError, match=kernel):
        call(kernel, arguments)


@pytest.mark.parametrize(
    ("kernel", "name", "index", "value"),
    [
        ("read_windows", "lengths", 0, 0),
        ("read_windows", "lengths", 3, 513),
        ("read_windows", "lengths", 3, 2**62),
        ("read_windows", "weights", 1, 2**62),
        ("read_windows", "prefixes", 1, -1),
        ("read_windows", "crt", 0, -1),
        ("read_windows", "crt", 0, 420),
        ("read_windows", "digits", 5, 3),
        ("poses", "windows", 4, 4),
        ("poses", "windows", 4, -1),
        ("poses", "windows", 0, 2**63 - 1),
        ("poses", "crt", 3, -(2**63)),
        ("search_map", "item_cells", 3, 5),
        ("search_map", "item_cells", 3, -1),
        ("search_map", "first", 1, -2),
        ("search_map", "first", 1, 5),
        ("search_map", "first", 5, 11),
        ("search_map", "use_item", 0, 5),
        ("search_map", "use_item", 0, -1),
        ("search_map", "use_item", 1, 0),
        ("search_map", "use_row", 0, 2),
        ("search_map", "use_row", 0, -1),
        ("search_map", "values", 0, 2),
        ("search_map", "words", 0, 4),
        ("search_map", "words", 1, 0),
        ("search_map", "words", 0, 3),
        ("search_map", "parts", 1, 4),
        ("search_map", "parts", 3, 3),
        ("search_map", "weights", 0, 0),
        ("light_bits", "first", 0, -1),
        ("light_bits", "first", 1, 49),
        ("light_bits", "first", 3, 52),
        ("light_bits", "readable", 1, 1),
        ("light_bits", "tick", 3, 0),
        ("light_bits", "tick", 19, 2**40),
        ("light_bits", "tick", 49, 2**63 - 1),
        ("light_bits", "tick", 0, -(2**63)),
        ("light_places", "value", 4, 65),
        ("light_places", "value", 4, -128),
        ("light_places", "first", 0, -1),
        ("light_places", "first", 1, 71),
        ("light_places", "first", 3, 201),
        ("light_places", "taps", 0, 1 << 17),
        ("light_places", "taps", 1, -1),
        ("light_places", "match", 9, 2**31 - 1),
        ("light_places", "miss", 9, -(2**31)),
        ("light_expected", "value", 4, -65),
        ("light_expected", "first", 2, 10),
        ("light_expected", "polynomial", 3, 2),
        ("light_expected", "polynomial", 3, -1),
    ],
)
def test_items_that_are_no_valid_index(kernel: str, name: str, index: int, value: int) -> None:
    arguments = CASES[kernel]()
    arguments[name].reshape(-1)[index] = value
    with pytest.raises(ValueError, match=name):
        call(kernel, arguments)


@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan])
@pytest.mark.parametrize(
    ("kernel", "name"), [("light_bits", "ticks_per_chip"), ("scan_landmarks", "step")]
)
def test_scales_that_are_not_positive(kernel: str, name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is not a finite number above zero"):
        call(kernel, {**CASES[kernel](), name: value})


def test_a_block_larger_than_the_image() -> None:
    with pytest.raises(ValueError, match="block is 13, expected 1 to 12"):
        call("find_dots", {**find_dots(), "block": 13})


def test_a_landmark_table_is_not_read_beyond_its_border() -> None:
    # As float32, the index of this point rounds up to the border of the table.
    size = 9
    arguments = scan_landmarks()
    arguments["points"][:] = [np.nextafter(np.float32(4), np.float32(0)) * 0.5, 0]
    arguments["centres"][:] = 0
    arguments["headings"][:] = 0
    guarded = np.full((size + 1, size, 4), np.nan, np.float32)
    guarded[:size] = 1
    arguments["table"] = guarded[:size]
    call("scan_landmarks", arguments)
    assert np.isfinite(arguments["cost"]).all()


FLOAT_INPUTS = [
    (kernel, name)
    for kernel, name in ARRAYS
    if CASES[kernel]()[name].dtype.kind == "f" and name not in OUTPUTS[kernel]
]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0])
@pytest.mark.parametrize(("kernel", "name"), FLOAT_INPUTS)
def test_extreme_floats_do_not_crash(kernel: str, name: str, value: float) -> None:
    arguments = CASES[kernel]()
    arguments[name].reshape(-1)[::2] = value
    call(kernel, arguments)


@pytest.mark.parametrize("value", [-(2**63), 2**63 - 1])
def test_indices_of_sequences_are_taken_modulo_their_length(value: int) -> None:
    arguments, wrapped = light_expected(), light_expected()
    arguments["index"][:] = value
    wrapped["index"][:] = value % SEQUENCE_LENGTH
    call("light_expected", arguments)
    call("light_expected", wrapped)
    assert np.array_equal(arguments["rows"], wrapped["rows"])


def test_bytes_and_memoryviews_are_arrays() -> None:
    arguments, expected = window_edges(), window_edges()
    arguments["windows"] = arguments["windows"].tobytes()
    arguments["rises"] = bytearray(3)
    call("window_edges", arguments)
    call("window_edges", expected)
    assert bytes(arguments["rises"]) == expected["rises"].tobytes()
    assert np.array_equal(arguments["tick"], expected["tick"])


SMALL_KERNELS = [kernel for kernel in CASES if kernel not in {"light_places", "light_expected"}]
"""Kernels without the large tables of sequences, whose arguments take microseconds to create."""


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(kernel=st.sampled_from(SMALL_KERNELS), data=st.data())
def test_inconsistent_integers_raise_or_pass(kernel: str, data: st.DataObject) -> None:
    arguments = CASES[kernel]()
    for name in (name for owner, name in INTEGERS if owner == kernel):
        change = st.sampled_from([0, 0, 0, -2, -1, 1, 2, 40])
        arguments[name] = max(arguments[name] + data.draw(change, label=name), -1)
    with contextlib.suppress(ValueError):
        call(kernel, arguments)
