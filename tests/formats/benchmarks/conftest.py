"""Fixtures of the tests of the benchmarks."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable

import pytest

from locatk.formats.benchmarks.figures import Duration, Figure


@pytest.fixture(scope="session")
def run_in_process() -> Callable[[str], list[float]]:
    """Return a replacement of ``run_single_threaded`` that runs the call in this process."""

    def run(call: str) -> list[float]:
        path = re.match(r"[\w.]+(?=\.)", call)
        assert path is not None
        module = importlib.import_module(f"locatk.formats.benchmarks.{path[0]}")
        numbers = eval(call.removeprefix(f"{path[0]}."), vars(module))
        return [float(number) for number in numbers]

    return run


@pytest.fixture(scope="session")
def time_once() -> Callable[..., Duration]:
    """Return a replacement of ``time_call`` that runs the call once, with a fixed duration."""

    def run(call: Callable[[], object], *options: object) -> Duration:
        call()
        return Duration(0.5, 1.0)

    return run


@pytest.fixture(scope="session")
def by_name() -> Callable[[Iterable[Figure]], dict[str, Figure]]:
    """Return a function that returns figures by name, which occurs once."""

    def collect(figures: Iterable[Figure]) -> dict[str, Figure]:
        found = list(figures)
        named = {figure.name: figure for figure in found}
        assert len(named) == len(found)
        return named

    return collect
