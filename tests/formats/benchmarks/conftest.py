"""Fixtures of the tests of the benchmarks."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable

import pytest


@pytest.fixture(scope="session")
def run_here() -> Callable[[str], list[float]]:
    """Return a replacement of ``run_single_threaded`` that runs the call in this process."""

    def run(call: str) -> list[float]:
        path = re.match(r"[\w.]+(?=\.)", call)
        assert path is not None
        module = importlib.import_module(f"locatk.formats.benchmarks.{path[0]}")
        numbers = eval(call.removeprefix(f"{path[0]}."), vars(module))
        return [float(number) for number in numbers]

    return run
