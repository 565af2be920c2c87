"""Plans: figures of the field, the rules, and warnings whose remedy works."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.design.materials import disc_magnet
from locatk.core.polaris.design.planning import (
    PLACEMENT_SIGMA_RAD,
    ReadingConditions,
    compact_spacing,
    disc_field,
    evaluate_design,
    field_width,
    neighbour_error,
    sample_layouts,
)
from locatk.core.polaris.mlx90393 import Settings
from locatk.core.polaris.tag import AsBuiltTag, Magnet, Tags

MINI = Tags(
    order=2,
    magnets=3,
    spacing_m=0.016,
    clearance_m=0.004,
    magnet=disc_magnet(1e-3, 0.5e-3, grade="N52"),
)
MINI_USE = ReadingConditions(
    sensors=3, sensor_spacing_m=0.008, settings=Settings(filt=5), rate_hz=17, speed_mps=0.005
)


def peak_ut(magnet: Magnet, height_mm: float) -> float:
    return float(np.linalg.norm(disc_field(magnet, np.array([[0, 0, height_mm * 1e-3]])))) * 1e6


@pytest.mark.parametrize(
    ("height", "field"), [(5, 1374), (8, 346), (10, 178.8), (11.6, 115), (15, 53.4), (20, 22.6)]
)
def test_field_above_a_magnet(height: float, field: float) -> None:
    assert peak_ut(Magnet(), height) == pytest.approx(field, rel=0.005)


def test_field_of_the_small_magnet() -> None:
    small = disc_magnet(1e-3, 0.5e-3, grade="N52")
    assert peak_ut(small, 10) == pytest.approx(45, rel=0.01)
    assert peak_ut(small, 5) == pytest.approx(359, rel=0.005)


def test_widths_of_the_field() -> None:
    magnet = Magnet()
    assert field_width(magnet, 0.01, 0.5) * 1e3 == pytest.approx(22.0, abs=0.05)
    assert field_width(magnet, 0.01, 0.5, across=True) * 1e3 == pytest.approx(15.5, abs=0.06)
    assert field_width(magnet, 0.01, 0.1) * 1e3 == pytest.approx(49.6, abs=0.1)
    assert field_width(magnet, 0.005, 0.1) * 1e3 == pytest.approx(25.2, abs=0.1)


def test_the_rule_gives_the_spacings_of_the_paper() -> None:
    assert compact_spacing(Magnet(), 0.01) == 0.040
    assert compact_spacing(disc_magnet(1e-3, 0.5e-3, grade="N52"), 0.004) == 0.016


@pytest.mark.parametrize(
    ("ratio", "degrees", "mm"),
    [(2, 9.5, 3.3), (2.5, 5.6, 2.8), (3, 3.5, 2.4), (4, 1.6, 1.8), (5, 0.85, 1.4), (6, 0.5, 1.1)],
)
def test_effect_of_a_neighbour(ratio: float, degrees: float, mm: float) -> None:
    angle, shift = neighbour_error(ratio * 0.01, 0.01)
    assert math.degrees(angle) == pytest.approx(degrees, rel=0.08)
    assert shift * 1e3 == pytest.approx(mm, abs=0.2)


def test_merged_peaks_have_no_error() -> None:
    assert all(math.isnan(value) for value in neighbour_error(0.015, 0.01))


def test_the_default_works() -> None:
    result = evaluate_design(Tags())
    assert result.warnings == ()
    assert result.signal_to_noise == pytest.approx(200, rel=0.05)
    assert result.between_t * 1e6 == pytest.approx(63.9, abs=0.1)
    assert result.rate_hz == pytest.approx(61, abs=0.5)
    assert result.max_orientations in (9, 10)
    assert result.capacity == 327_680
    assert result.play_m == pytest.approx(0.04)
    assert result.noise_from == "measured"


@pytest.mark.slow
def test_the_papers_rate_is_not_the_sensors() -> None:
    """100 Hz with a conversion of 16.05 ms: the warning's settings do it."""
    result = evaluate_design(Tags(), ReadingConditions(rate_hz=100))
    (warning,) = result.warnings
    assert "16.05 ms" in warning
    assert "61.2 Hz" in warning
    assert result.rate_hz == result.max_rate_hz
    osr, filt = map(int, re.findall(r"osr (\d) filt (\d) gives", warning)[0])
    better = evaluate_design(
        Tags(), ReadingConditions(rate_hz=100, settings=Settings(osr=osr, filt=filt))
    )
    assert better.warnings == ()
    assert better.rate_hz == 100
    assert better.noise_from == "assumed"
    assert any("never measured" in note for note in better.notes)
    assert "no osr and filt" in evaluate_design(Tags(), ReadingConditions(rate_hz=2000)).warnings[0]


def test_the_mini_tag_works() -> None:
    result = evaluate_design(MINI, MINI_USE)
    assert result.warnings == ()
    assert result.capacity == 512
    assert result.rate_hz == 17
    assert result.free_speed.y_m < 0.58e-3
    assert result.free_speed.angle_rad < math.radians(0.997)
    assert any("to within 0 mm" in note for note in result.notes)


@pytest.mark.slow
def test_too_many_orientations() -> None:
    """6 degrees, as measured on the published tags: 8 are fine, 16 and 20 are not."""
    for orientations in (8, 16, 20):
        result = evaluate_design(replace(Tags(), orientations=orientations))
        assert len(result.warnings) == (orientations > 8)
    assert "16" in evaluate_design(replace(Tags(), orientations=16)).warnings[0]
    most = result.max_orientations
    assert evaluate_design(replace(Tags(), orientations=most)).warnings == ()
    assert evaluate_design(replace(Tags(), orientations=most + 1)).warnings != ()
    jig = float(re.findall(r"come to ([\d.]+) degrees", result.warnings[0])[0])
    better = ReadingConditions(placement_rad=math.radians(jig * 0.97))
    assert evaluate_design(replace(Tags(), orientations=20), better).warnings == ()


def test_misread_is_the_chance_of_a_tag() -> None:
    tags, error = replace(Tags(), orientations=16), math.radians(6)
    result = evaluate_design(tags, ReadingConditions(placement_rad=error))
    off = np.random.default_rng(0).normal(0, error, (100_000, tags.magnets))
    assert result.misread == pytest.approx(
        (np.abs(off) > math.radians(11.25)).any(1).mean(), rel=0.03
    )


def test_calibrated_tags_give_their_placement_error() -> None:
    off = np.radians([4.3, -2.2, 13.0, 0.0, -2.8])
    tags = replace(Tags(), built={7: AsBuiltTag(np.zeros((5, 2)), off, 10)})
    assert evaluate_design(tags).placement_rad == pytest.approx(np.sqrt(np.mean(off**2)))
    assert evaluate_design(Tags()).placement_rad == PLACEMENT_SIGMA_RAD
    assert evaluate_design(tags, ReadingConditions(placement_rad=0.01)).placement_rad == 0.01


def test_too_fast() -> None:
    result = evaluate_design(Tags(), ReadingConditions(speed_mps=2))
    (warning,) = result.warnings
    most = float(re.findall(r"at most ([\d.]+) m/s", warning)[0])
    assert evaluate_design(Tags(), ReadingConditions(speed_mps=most * 0.98)).warnings == ()
    assert evaluate_design(Tags(), ReadingConditions(speed_mps=most * 1.03)).warnings != ()
    wild = evaluate_design(Tags(), ReadingConditions(speed_mps=1e6))
    assert any("too fast" in warning for warning in wild.warnings)


@pytest.mark.slow
def test_too_weak() -> None:
    result = evaluate_design(
        replace(Tags(), clearance_m=0.04, spacing_m=0.16), ReadingConditions(sensors=17)
    )
    assert any("too weak" in warning for warning in result.warnings)
    assert result.between_to_noise < 6
    assert evaluate_design(replace(Tags(), clearance_m=0.02, spacing_m=0.08)).warnings == ()


def test_saturation() -> None:
    strong = replace(Tags(), magnet=disc_magnet(0.005, 0.003, grade="N52"))
    (warning,) = evaluate_design(strong).warnings
    assert "saturate" in warning
    assert evaluate_design(strong).peak_t > Settings().range_t.min()
    assert (
        evaluate_design(strong, ReadingConditions(settings=Settings(resolution=3))).warnings == ()
    )


def test_magnets_that_are_no_points() -> None:
    wide = replace(Tags(), magnet=disc_magnet(0.004, 0.0005, grade="N35"), clearance_m=0.0035)
    dense = ReadingConditions(sensors=33, sensor_spacing_m=0.005, settings=Settings(resolution=3))
    (warning,) = evaluate_design(wide, dense).warnings
    assert "diameter" in warning
    assert evaluate_design(replace(wide, clearance_m=0.0041), dense).warnings == ()


@pytest.mark.slow
def test_spacing() -> None:
    below = evaluate_design(replace(Tags(), spacing_m=0.016))
    assert below.warnings == ()
    assert any("39.7 mm" in note and "joint" in note for note in below.notes)
    assert not any("39.7 mm" in note for note in evaluate_design(Tags()).notes)
    (warning,) = evaluate_design(replace(Tags(), spacing_m=0.014)).warnings
    assert "15 mm" in warning


def test_a_tag_wider_than_the_array() -> None:
    result = evaluate_design(Tags(), ReadingConditions(sensors=4))
    (warning,) = result.warnings
    needed = int(re.findall(r"take (\d+) sensors", warning)[0])
    assert needed == 5
    assert evaluate_design(Tags(), ReadingConditions(sensors=needed)).warnings == ()
    alone = evaluate_design(Tags(), ReadingConditions(sensors=1))
    assert alone.between_t == alone.peak_t


def test_noise_that_is_given_counts() -> None:
    result = evaluate_design(Tags(), ReadingConditions(noise_t=0.5e-6))
    assert result.noise_from == "given"
    assert result.signal_to_noise == pytest.approx(358, rel=0.005)


@pytest.mark.parametrize(
    ("tags", "use", "said"),
    [
        (replace(Tags(), clearance_m=0.0002), ReadingConditions(), "clearance"),
        (replace(Tags(), spacing_m=math.nan), ReadingConditions(), "spacing"),
        (replace(Tags(), spacing_m=0.001), ReadingConditions(), "do not fit"),
        (replace(Tags(), magnets=2), ReadingConditions(), "2 magnets"),
        (Tags(), ReadingConditions(speed_mps=0), "speed"),
        (Tags(), ReadingConditions(rate_hz=-1), "rate"),
        (Tags(), ReadingConditions(noise_t=0), "noise"),
        (Tags(), ReadingConditions(placement_rad=math.inf), "placement"),
        (Tags(), ReadingConditions(sensors=0), "no bar"),
    ],
)
def test_designs_that_cannot_be(tags: Tags, use: ReadingConditions, said: str) -> None:
    with pytest.raises(InputError, match=said):
        evaluate_design(tags, use)


def test_layouts_are_those_of_the_family() -> None:
    tags = replace(Tags(), ids=(5, 1234))
    members = [layout_of(tags, number) for number in (5, 1234)]
    assert all(layout in members for layout in sample_layouts(tags, 8))
    huge = Tags(order=12, magnets=60, orientations=20)
    assert sample_layouts(huge, 3) == sample_layouts(huge, 3)
