"""The benchmark of capture on a small scale: losses, recovery and speed."""

from __future__ import annotations

import sys
from collections.abc import Iterable

import pytest

from locatk.formats.benchmarks import capture
from locatk.formats.benchmarks.figures import Figure

if sys.platform == "win32":
    pytest.skip("no pseudo-terminals", allow_module_level=True)


def named(figures: Iterable[Figure]) -> dict[str, Figure]:
    return {figure.name: figure for figure in figures}


@pytest.mark.slow
def test_a_short_soak() -> None:
    found = named(capture.soak_figures(0.4))
    assert found["soak: bytes lost or wrong"].value == 0
    assert found["soak: bad or missing frames"].value == 0
    assert found["soak: one core"].target == 60
    assert (found["soak: one core"].value or 0) > 0


@pytest.mark.parametrize(
    ("found", "wrong"),
    [(b"cdefgh", 0), (b"cdxfgh", 1), (b"cdef", 2), (b"cdefghi", 1), (b"zz", 8)],
)
def test_wrong_bytes_are_counted(found: bytes, wrong: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes before the first recorded one do not count."""
    monkeypatch.setattr(capture, "SYNC_BYTES", 2)
    assert capture.count_wrong_bytes(found, b"abcdefgh") == wrong


@pytest.mark.slow
def test_a_kill() -> None:
    found = named(capture.kill_figures(1))
    assert found["kill -9: longest loss"].target == 0.5
    assert 0 <= (found["kill -9: longest loss"].value or 0) < 5
    assert found["kill -9: made whole by recover"].value == 100


def test_damages() -> None:
    found = named(capture.damage_figures(9))
    assert found["recover: whole chunks saved"].value == 100
    assert found["recover: altered messages returned"].value == 0
    assert found["recover: outputs unreadable or refused"].value == 0


@pytest.mark.slow
def test_info_of_a_large_file() -> None:
    figure = capture.info_figure(2_000_000)
    assert figure.target == 1.0
    assert (figure.value or 0) > 0
