"""The benchmark of light: figures and their targets."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import pytest

from locatk.core.lighthouse.demodulation import identification
from locatk.formats.benchmarks import infrared
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.importers.libsurvive.recording import read_libsurvive


def named(figures: Iterable[Figure]) -> dict[str, Figure]:
    return {figure.name: figure for figure in figures}


def missed(figures: Iterable[Figure]) -> list[str]:
    return [figure.name for figure in figures if figure.met is False]


@pytest.mark.slow
def test_the_demodulation_capture(data: Path) -> None:
    found = named(infrared.demodulation_figures(data / "lighthouse"))
    assert missed(found.values()) == []
    assert (found["bursts decoded of 11,136"].target, found["false polynomials"].target) == (
        98.5,
        0.05,
    )
    # Fragments must agree with the sent sequence only.
    assert (found["rims taken for a wrong place"].value or 0) < 1.5
    assert (found["bursts read by themselves"].value or 0) > 96.5


@pytest.mark.slow
def test_windows_beat_the_peer_and_the_paper_is_the_paper(data: Path) -> None:
    found = named(infrared.window_figures(data / "lighthouse"))
    assert (found["windows of 16 us read"].value or 0) > 95
    assert found["windows: false polynomials"].value == 0
    paper = found["windows read by --method paper"]
    assert paper.value == pytest.approx(79.6, abs=1.5)
    assert paper.peer_value == 79.6


def test_strong_and_weak_recordings_of_the_deck(data: Path) -> None:
    found = infrared.fpga_figures(data / "lighthouse")
    assert [figure.target for figure in found] == [103, 95]
    assert missed(found) == []


def test_table_iii_of_the_paper_is_in_its_captures(data: Path) -> None:
    """The captures contain a line for each stage of the firmware."""
    if not (data / "lighthouse/benchmarks/twoLH_2D/Logic_analyser_capture.sal").exists():
        pytest.skip("the captures are missing")
    found = named(infrared.firmware_figures(data / "lighthouse"))
    for stage, pulses, mean_us, sd_us in (
        ("demodulation", 10_807, 623.15, 3.65),
        ("polynomial", 10_807, 127.42, 26.95),
        ("LFSR index", 10_763, 157.95, 155.61),
        ("position, one station", 261_691, 141.33, None),
        ("position, two stations", 32_066, 143.42, None),
    ):
        mean = found[f"microcontroller, {stage}: mean"]
        assert mean.value == pytest.approx(mean_us, abs=0.01)
        assert mean.how.startswith(f"{pulses:,} pulses")
        if sd_us is not None:
            sd = found[f"microcontroller, {stage}: SD"]
            assert sd.value == pytest.approx(sd_us, abs=0.01)
    published = [row for row in found.values() if row.peer == "paper, Table III"]
    assert len(published) == 8
    for row in published:
        # The paper rounds to three digits, and 143.4 to 144.
        assert row.value == pytest.approx(row.peer_value, abs=0.7), row.name
    assert found["microcontroller: load"].value == pytest.approx(18.14, abs=0.01)
    assert found["microcontroller: captures with an index"].value == pytest.approx(99.59, abs=0.01)


@pytest.mark.slow
def test_differences_from_stored_calibrations_are_counted(data: Path) -> None:
    path = data / "lighthouse" / "libsurvive" / infrared.TRACKER_RECORDING
    session = read_libsurvive([path])
    assert infrared.compare_calibrations(session, path).value == 0
    for station in session.stations[:1]:
        assert station.calibration is not None
        station.calibration.sweeps[1, 3] += 2e-6  # of 1e-6 that libsurvive's file holds
    assert infrared.compare_calibrations(session, path).value == 1


@pytest.mark.slow
def test_wrong_windows_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert infrared.count_wrong_windows(3) == 0
    monkeypatch.setattr(identification, "MIN_PREDICTED_BITS", 50)  # more than 60 bits can show
    assert infrared.count_wrong_windows(3) == 131_071


def test_noise_that_passes_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(infrared, "NOISE_BURSTS", 3_000)
    assert infrared.false_alarm_fraction() < 0.005
    monkeypatch.setattr(infrared, "MIN_STANDALONE_EVIDENCE_BITS", 10.0)
    assert infrared.false_alarm_fraction() > 0.05


def test_without_data_each_figure_gives_the_reason(tmp_path: Path) -> None:
    (tmp_path / "lighthouse").mkdir()
    for measure in (infrared.demodulation_figures, infrared.fpga_figures):
        (row,) = infrared.explain(partial(measure, tmp_path / "lighthouse"), {"a figure": "%"})
        assert row.value is None
        assert row.how.startswith("not measured")
    rows = infrared.tracker_figures(tmp_path / "lighthouse")
    assert len(rows) == 3
    assert all(row.value is None and row.met is None for row in rows)
