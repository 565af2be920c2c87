"""Analysis of a geometry against magpylib, reference figures and itself.

Reference figures were computed with an independent prototype of the bars' field (numpy, equal to
magpylib 6.1.0); "the paper" is DOI 10.5772/57517.
"""

from __future__ import annotations

import math
from dataclasses import replace

import magpylib
import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.design.analysis import (
    LandmarkAnalysis,
    analyse_landmark,
    check_geometry,
    landmark_warnings,
    pitch_warnings,
)
from locatk.core.landmarks.design.territory import (
    max_field,
    max_neighbour_field,
    min_pitch_for_field,
    threshold_contour,
)
from locatk.core.landmarks.design.valleys import (
    centre_from_valleys,
    find_valleys,
    points_on_circle,
    valid_sensor_heights,
)
from locatk.core.landmarks.field import basis, landmark_field
from locatk.core.landmarks.landmark import PATTERNS, Geometry, code_of, signs

ONE = replace(Geometry(), remanence_t=1.0, threshold_t=2.73e-3)
"""Default geometry with a remanence of 1 T and a threshold of 2.73 mT per tesla."""
LONG = replace(ONE, bar_length_m=0.04, sensor_height_m=0.005, threshold_t=2.84e-3)


@pytest.fixture(scope="module")
def usual() -> LandmarkAnalysis:
    return analyse_landmark(ONE)


def degrees(analysis: LandmarkAnalysis, letters: str) -> np.ndarray:
    return np.degrees(analysis.patterns[PATTERNS.index(letters)].valleys_rad)


def test_valleys_equal_the_reference(usual: LandmarkAnalysis) -> None:
    """Angles equal those of the prototype to the digits given."""
    np.testing.assert_allclose(degrees(usual, "NSNS"), [0, 90, 180, 270], atol=1e-6)
    np.testing.assert_allclose(degrees(usual, "NNNN"), 45.0 * np.arange(8), atol=1e-6)
    np.testing.assert_allclose(degrees(usual, "NNNS"), [6.0, 44.2, 90, 135.8, 174, 270], atol=0.05)
    np.testing.assert_allclose(
        degrees(usual, "NNSS"), [5.9, 45, 84.1, 185.9, 225, 264.1], atol=0.05
    )
    for plus, minus in (("NNNS", "SSSN"), ("NNNN", "SSSS")):
        one, other = (usual.patterns[PATTERNS.index(letters)] for letters in (plus, minus))
        np.testing.assert_allclose(one.valleys_rad, other.valleys_rad, atol=1e-9)
        np.testing.assert_array_equal(one.is_rising, ~other.is_rising)
        np.testing.assert_allclose(one.peaks_t, -other.peaks_t)


@pytest.mark.parametrize("geometry", [ONE, LONG])
def test_counts_are_those_of_the_paper(geometry: Geometry) -> None:
    result = analyse_landmark(geometry)
    assert [pattern.letters for pattern in result.patterns] == list(PATTERNS)
    assert [len(pattern.valleys_rad) for pattern in result.patterns] == [4, 6, 6, 6, 8, 8]
    assert not any(pattern.is_collapsed for pattern in result.patterns)
    for pattern in result.patterns:
        assert (np.diff(pattern.valleys_rad) > 0).all()
        # Mountains change sign at each valley, and say whether the field rises there.
        np.testing.assert_array_equal(pattern.is_rising, pattern.peaks_t > 0)
        np.testing.assert_array_equal(pattern.is_rising, ~np.roll(pattern.is_rising, 1))


def test_valleys_are_zeros_of_magpylibs_field() -> None:
    collection = magpylib.Collection()
    for k, sign in enumerate(signs(code_of("NNNS"))):
        bar = magpylib.magnet.Cuboid(
            polarization=(0, ONE.remanence_t * sign, 0),
            dimension=(0.01, 0.03, 0.005),
            position=(0.025, 0, -0.0025),
        )
        collection.add(bar.rotate_from_angax(90 * k, "z", anchor=0))
    angle = analyse_landmark(ONE).patterns[2].valleys_rad

    def field(rotated: float) -> np.ndarray:
        circle = points_on_circle(0.025, angle + rotated)
        return collection.getB(np.column_stack([circle, np.full(len(angle), 0.012)]))[:, 2]

    # The field changes its sign within 0.0001 degrees, a hundredth of what the table shows.
    assert (field(-1.7e-6) * field(1.7e-6) < 0).all()


def test_peaks_equal_the_reference(usual: LandmarkAnalysis) -> None:
    """90-degree peaks are 23.1 to 24.3 mT/T, 45-degree ones 7.8 to 9.3; 53 and 9.6 if long."""
    wide, narrow = [], []
    for pattern in usual.patterns:
        width = np.diff(pattern.valleys_rad, append=pattern.valleys_rad[0] + 2 * math.pi)
        height = 1e3 * np.abs(pattern.peaks_t)
        wide += height[width > math.radians(70)].tolist()
        narrow += height[width < math.radians(60)].tolist()
    assert (min(wide), max(wide)) == pytest.approx((23.1, 24.3), abs=0.06)
    assert (min(narrow), max(narrow)) == pytest.approx((7.8, 9.3), abs=0.06)
    long = analyse_landmark(LONG).patterns
    assert 1e3 * long[0].peaks_t.max() == pytest.approx(53, abs=0.5)
    assert 1e3 * long[3].peaks_t.min() == pytest.approx(-54, abs=0.5)
    assert 1e3 * np.abs(long[3].peaks_t).min() == pytest.approx(9.6, abs=0.06)


def test_intersection_has_the_reference_bias(usual: LandmarkAnalysis) -> None:
    """2.6 mm for landmarks 2 and 3, 4.2 mm with 40 mm bars, towards the middle bar."""
    assert usual.patterns[2].bias_m == pytest.approx([0, 2.6e-3], abs=0.05e-3)
    assert usual.patterns[1].bias_m == pytest.approx([0, 2.6e-3], abs=0.05e-3)
    assert analyse_landmark(LONG).patterns[2].bias_m == pytest.approx([0, 4.2e-3], abs=0.05e-3)
    for k in (0, 3, 4, 5):
        assert usual.patterns[k].bias_m == pytest.approx([0, 0], abs=1e-8)


def test_crossing_is_of_the_labels_of_the_paper() -> None:
    """1'-4' and 2'-6' of landmark 3, counted from the valley between the two large angles."""
    angle = find_valleys(ONE, signs(code_of("NNNS")))[0]
    start = int(np.argmin(np.abs(angle - math.radians(270))))
    label = points_on_circle(0.025, np.roll(angle, -start))
    one, two, four, six = label[0], label[1], label[3], label[5]
    t = np.linalg.solve(np.column_stack([four - one, two - six]), two - one)[0]
    np.testing.assert_allclose(centre_from_valleys(ONE, angle), one + t * (four - one), atol=1e-12)


def test_radii_equal_the_reference(usual: LandmarkAnalysis) -> None:
    """r2 and NSNS agree to the digits given; r1 depends on the limits of gulfs: to 0.6 mm."""
    assert 1e3 * usual.r2_m == pytest.approx(54.7, abs=0.1)
    assert 1e3 * usual.patterns[0].r2_m == pytest.approx(54, abs=0.1)
    assert 1e3 * usual.patterns[4].r1_m == pytest.approx(44.7, abs=0.6)
    assert 1e3 * usual.r1_m == pytest.approx(45.0, abs=0.5)
    long = analyse_landmark(LONG)
    assert 1e3 * long.r2_m == pytest.approx(54.4, abs=0.1)
    assert 1e3 * long.r1_m == pytest.approx(45.4, abs=0.5)
    assert math.isnan(usual.patterns[0].r1_m)
    assert math.isnan(usual.patterns[4].r2_m)


def test_contour_is_at_the_threshold_of_the_field() -> None:
    phi = np.radians(np.array([10.0, 22.5, 30, 45, 60, 200, 225, 250, 300]))
    strengths = signs(code_of("NNNS"))
    result = threshold_contour(ONE, strengths[:, None], phi)[:, 0]
    # In the gulf between equal bars the field never comes to the threshold.
    np.testing.assert_array_equal(np.isnan(result), phi == np.radians(45.0))
    field = np.abs(basis(ONE, points_on_circle(result, phi)) @ strengths)
    np.testing.assert_allclose(field[[1, 2, 5, 6, 7, 8]], ONE.threshold_t, rtol=3e-3)
    outside = np.abs(basis(ONE, points_on_circle(result * 1.05, phi)) @ strengths)
    assert (outside[np.isfinite(result)] < ONE.threshold_t).all()
    # Contour of NNNS by the prototype, at a threshold of 2.90 mT/T.
    reference = replace(ONE, threshold_t=2.90e-3)
    shown = threshold_contour(
        reference, strengths[:, None], np.radians([15, 22.5, 60, 67.5, 210, 217.5])
    )[:, 0]
    np.testing.assert_allclose(1e3 * shown, [41, 44, 46, 46, 56, 56], atol=1)


def test_no_contour_without_a_field() -> None:
    weak = replace(ONE, threshold_t=0.5)
    assert np.isnan(threshold_contour(weak, signs([5, 7]).T, np.radians([20.0, 50.0]))).all()
    result = analyse_landmark(weak)
    assert math.isnan(result.r1_m)
    assert math.isnan(result.min_pitch_m)
    assert any("threshold" in text for text in landmark_warnings(result))


def test_gulfs_are_some_millimetres_wide(usual: LandmarkAnalysis) -> None:
    """Gulfs are +-5 to 8 degrees wide at the corners between equal bars."""
    nnnn = usual.patterns[4]
    corners = np.degrees(nnnn.gulfs_rad[1::2])
    assert ((corners > 8) & (corners < 18)).all()
    assert (nnnn.gulfs_rad[0::2] > nnnn.gulfs_rad[1::2]).all()


@pytest.mark.parametrize(("geometry", "low", "high"), [(ONE, 0.020, 0.030), (LONG, 0.015, 0.020)])
def test_heights_end_at_the_collapse_of_the_table(
    geometry: Geometry, low: float, high: float
) -> None:
    """40 mm bars give 2 valleys from a height of 20 mm on, 30 mm bars still 6 there."""
    bottom, top = valid_sensor_heights(geometry)
    assert bottom == 0
    assert low < top < high
    for step, right in ((-5e-5, True), (5e-5, False)):
        shapes = analyse_landmark(replace(geometry, sensor_height_m=top + step)).patterns
        assert (not any(pattern.is_collapsed for pattern in shapes)) == right


def test_a_circle_beyond_the_bars_has_no_valid_height() -> None:
    assert all(map(math.isnan, valid_sensor_heights(replace(ONE, circle_m=0.1))))


def test_far_neighbours_are_let_pass(usual: LandmarkAnalysis) -> None:
    """Contours need 2 x (54 + 25) mm; the field of a neighbour is below 15 uT at 200 mm."""
    assert usual.contour_pitch_m == pytest.approx(0.160, abs=0.002)
    nominal = analyse_landmark(Geometry())
    assert 0.19 < nominal.field_pitch_m < 0.2
    assert nominal.min_pitch_m == nominal.field_pitch_m
    one, all_eight = max_neighbour_field(Geometry(), 0.2)
    assert 11e-6 < one < 15e-6
    assert one < all_eight < 8 * one
    at_limit = max_neighbour_field(Geometry(), nominal.field_pitch_m)[0]
    assert at_limit == pytest.approx(nominal.neighbour_t, rel=0.01)
    assert min_pitch_for_field(Geometry(), 1e-12) > 1 or math.isnan(
        min_pitch_for_field(Geometry(), 1e-12)
    )


def test_neighbours_are_as_bad_as_the_worst_of_all_codes() -> None:
    """By trying every code at each of the eight places, one circle point at a time."""
    circle = points_on_circle(0.025, np.radians(3.0 * np.arange(120)))
    total, nearest = np.zeros(120), 0.0
    for x in (-0.18, 0, 0.18):
        for y in (-0.18, 0, 0.18):
            if (x, y) != (0, 0):
                field = [landmark_field(ONE, code, circle - [x, y]) for code in range(16)]
                worst = np.abs(field).max(axis=0)
                total += worst
                nearest = max(nearest, worst.max())
    one, all_eight = max_neighbour_field(ONE, 0.18)
    assert one == pytest.approx(nearest, rel=1e-9)
    assert all_eight == pytest.approx(total.max(), rel=1e-9)


@pytest.mark.slow
def test_range_of_hall_sensors_follows_the_largest_field() -> None:
    result = analyse_landmark(Geometry())
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.06, 0.06, (20_000, 2))
    sampled = max(np.abs(landmark_field(Geometry(), code, points)).max() for code in range(16))
    assert sampled <= result.largest_t * 1.001
    assert sampled > 0.98 * result.largest_t
    assert result.range_t == pytest.approx(1.25 * result.largest_t)
    assert result.hall_class == (50.0, 0.042)
    assert analyse_landmark(replace(Geometry(), remanence_t=0.4)).hall_class == (100.0, 0.021)
    close = analyse_landmark(replace(Geometry(), sensor_height_m=0.0005))
    assert close.hall_class is None
    assert any("hall" in text for text in landmark_warnings(close))


def test_lines_over_the_bars_equal_the_reference() -> None:
    """Slopes are in mT/mm at 1.2 T; zeros next to the odd bar are 2.6 mm off."""
    shapes = analyse_landmark(Geometry()).patterns
    np.testing.assert_allclose(np.abs(shapes[0].slope_t_per_m), 1.94, rtol=0.01)
    np.testing.assert_allclose(shapes[4].slope_t_per_m, 1.13, rtol=0.03)
    np.testing.assert_allclose(shapes[2].slope_t_per_m[[0, 2]], 1.45, rtol=0.01)
    np.testing.assert_allclose(1e3 * shapes[2].zero_m, [2.6, 0, -2.6, 0], atol=0.05)
    for pattern in shapes:
        np.testing.assert_array_equal(
            np.sign(pattern.slope_t_per_m), signs(code_of(pattern.letters))
        )
        assert (pattern.departure_m < 1e-3).all()


def test_fields_grow_with_remanence_and_shrink_with_height() -> None:
    assert max_field(replace(ONE, remanence_t=0.5)) == pytest.approx(max_field(ONE) / 2)
    by_what = {row.deviation: row for row in analyse_landmark(Geometry()).tolerances}
    designed = by_what["as designed"]
    assert designed.bias_m == pytest.approx(2.6e-3, abs=0.05e-3)
    assert by_what["sensors 1 mm higher"].largest_t < designed.largest_t
    assert by_what["sensors 1 mm lower"].largest_t > designed.largest_t
    # A tenth of the threshold, or of the field, moves both radii by about 1 mm.
    stronger = by_what["bars 10 % stronger"]
    assert 1e3 * (stronger.r1_m - designed.r1_m) == pytest.approx(1, abs=0.5)
    assert 1e3 * (stronger.r2_m - designed.r2_m) == pytest.approx(1, abs=0.5)


def test_a_collapse_is_reported_with_a_remedy() -> None:
    high = analyse_landmark(replace(LONG, sensor_height_m=0.02))
    assert [len(pattern.valleys_rad) for pattern in high.patterns] == [4, 2, 2, 6, 8, 8]
    assert np.isnan(high.patterns[2].bias_m).all()
    (reported,) = [text for text in landmark_warnings(high) if "collapse" in text]
    assert "SSSN and NNNS collapse to 2 instead of 6" in reported
    assert "at most 17.8 mm" in reported
    assert not list(landmark_warnings(analyse_landmark(Geometry())))


def test_skewed_valleys_are_reported() -> None:
    """50 mm bars put the inner valleys at 16 to 18 degrees, which is too large."""
    bars = replace(ONE, bar_length_m=0.05, bar_width_m=0.005, radius_m=0.028, sensor_height_m=0.004)
    result = analyse_landmark(bars)
    assert math.degrees(result.patterns[2].skew_rad) == pytest.approx(17, abs=1)
    assert any("17 degrees" in text for text in landmark_warnings(result))


def test_close_landmarks_are_reported() -> None:
    result = analyse_landmark(Geometry())
    assert not list(pitch_warnings(result, 0.2))
    (field,) = pitch_warnings(result, 0.17)
    assert "at least 194 mm" in field
    assert len(list(pitch_warnings(result, 0.12))) == 2


def test_a_low_threshold_is_the_earths_field() -> None:
    low = analyse_landmark(replace(Geometry(), threshold_t=5e-5))
    assert any("Earth" in text for text in landmark_warnings(low))
    wide = analyse_landmark(replace(Geometry(), threshold_t=3e-2))
    assert any("threshold" in text or "territory" in text for text in landmark_warnings(wide))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"bar_length_m": 0.0}, "length"),
        ({"bar_width_m": -1.0}, "width"),
        ({"bar_height_m": math.nan}, "height of the bars"),
        ({"remanence_t": 12_000.0}, "12000 T"),
        ({"remanence_t": math.inf}, "remanence"),
        ({"radius_m": 0.019}, "overlap"),
        ({"bar_length_m": 0.041}, "overlap"),
        ({"sensor_height_m": 0.0}, "height of the sensors"),
        ({"circle_m": 0.0}, "circle"),
        ({"threshold_t": 0.0}, "threshold"),
    ],
    ids=str,
)
def test_bars_that_cannot_be_are_refused(change: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        analyse_landmark(replace(Geometry(), **change))


def test_bars_that_touch_are_none_of_those() -> None:
    check_geometry(LONG)
    check_geometry(replace(LONG, bar_length_m=0.0393, radius_m=0.02465))


def test_a_contour_beyond_the_searched_radii_is_unknown() -> None:
    weak = replace(Geometry(), threshold_t=1e-9)
    contour = threshold_contour(weak, signs([code_of("NSNS")]).T, np.radians([10.0, 100.0]))
    assert np.isnan(contour).all()


def test_a_territory_within_the_circle_of_the_sensors_is_reported() -> None:
    wide = analyse_landmark(replace(Geometry(), threshold_t=8e-3, circle_m=0.04))
    assert wide.r1_m < 0.04
    assert any("smaller than the circle" in text for text in landmark_warnings(wide))
    narrow = analyse_landmark(replace(Geometry(), threshold_t=8e-3))
    assert not any("smaller than the circle" in text for text in landmark_warnings(narrow))
