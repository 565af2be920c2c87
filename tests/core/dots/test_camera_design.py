"""Design of a camera over dots: the paper's sums, textbook optics, warnings and their remedies."""

from __future__ import annotations

import math
import subprocess
import sys
import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.dots.codec import codec
from locatk.core.dots.design.camera import compare_sensors, design_camera, suggest_camera
from locatk.core.dots.design.camera_measurement import camera_model, measure_camera
from locatk.core.dots.design.camera_optics import (
    PAPER_REFLECTANCE,
    electrons_of_paper,
    focus_range,
    frame_rate,
    window_diagonal_m,
    window_in_view,
)
from locatk.core.dots.design.camera_sensors import SENSORS, sensor_named
from locatk.core.dots.design.camera_setup import CameraSetup, Lens, Sensor
from locatk.core.dots.design.read_rate import (
    MAX_BLUR_PITCHES,
    MAX_MOTION_PITCHES,
    MAX_SHEAR,
)
from locatk.core.dots.localization import frames
from locatk.core.dots.simulation.session import SimulationOptions, camera, simulate
from locatk.core.errors import InputError

MT9V034 = Sensor("MT9V034", (752, 480), 6e-6, 60.0)
PAPER = CameraSetup(
    MT9V034, Lens(5.5e-3, distortion=0.045), 5.5e-3 * (1 + 0.046 / 0.024), 1 / 7684, binning=4
)
"""Hostettler et al. 2016, III-A."""


def only_warning(report) -> str:
    (warning,) = report.warnings
    return warning


def test_the_sums_of_the_paper() -> None:
    report = design_camera(PAPER)
    assert 1e3 * window_diagonal_m(8, 0.508e-3) == pytest.approx(5.39, abs=0.005)
    assert 1e6 * report.metres_per_px == pytest.approx(46)
    assert 1e3 * report.one_pixel_speed_mps == pytest.approx(353, abs=0.5)
    assert report.one_pixel_yaw_rate_rps * 30 / math.pi == pytest.approx(785, abs=0.5)
    # 188 x 120 px of 0.046 mm; the paper measures 8.59 x 5.48 mm after the correction of the lens.
    assert report.field_m == pytest.approx((8.59e-3, 5.48e-3), rel=0.01)
    assert report.window_dots == 8
    assert report.read_rate > 0.99
    assert report.warnings == ()


def test_parts_of_the_paper_have_its_prices() -> None:
    prices = {item.part: item.amount for item in design_camera(PAPER).materials}
    assert prices["image sensor"] == 12.86
    assert prices["infrared LED"] == pytest.approx(3 * 0.46)
    other = design_camera(replace(PAPER, sensor=Sensor("OV7251", (640, 480), 3e-6, 99.0)))
    assert {item.part: item.price for item in other.materials}["image sensor"] is None


def test_depth_of_field_of_a_textbook() -> None:
    # 50 mm, f/8, 3 m, c = 0.03 mm; hyperfocal distance f^2 / (N c) + f.
    setup = replace(PAPER, lens=Lens(50e-3, 8.0), distance_m=3.0)
    hyperfocal = 0.05**2 / (8 * 0.03e-3) + 0.05
    near, far = focus_range(setup, 0.03e-3)
    assert near == pytest.approx(3 * (hyperfocal - 0.05) / (hyperfocal + 3 - 0.1))
    assert far == pytest.approx(3 * (hyperfocal - 0.05) / (hyperfocal - 3))
    beyond = replace(setup, lens=Lens(5e-3, 8.0))  # hyperfocal distance 0.11 m
    assert math.isinf(focus_range(beyond, 0.03e-3)[1])


def test_diffraction_disc_of_a_textbook() -> None:
    # At infinity and f/8, green light: 2.44 * 0.55 um * 8 = 10.7 um.
    setup = replace(PAPER, lens=Lens(5e-3, 8.0), distance_m=9.0, wavelength_m=550e-9)
    assert design_camera(setup).airy_px * setup.pixel_m == pytest.approx(10.7e-6, rel=0.01)


def test_electrons_of_a_pixel_follow_from_photometry() -> None:
    # 1000 lx, diffuse reflectance 0.8, transmittance 0.9, far away at f/2: E R T / (4 N^2) on the
    # sensor; a lux second of 555 nm is 1 / 683 J / m^2, of photons of 3.58e-19 J; half are counted.
    setup = replace(PAPER, lens=Lens(5e-3, 2.0), distance_m=9.0, exposure_s=1e-3, binning=1)
    lux_seconds = 1000 * PAPER_REFLECTANCE * 0.9 / 16 * 1e-3
    photons = lux_seconds / 683 / 3.58e-19 * (6e-6) ** 2
    assert electrons_of_paper(setup, 1000.0) == pytest.approx(photons / 2, rel=0.01)


def test_less_light_gives_noise_and_lower_accuracy() -> None:
    bright = design_camera(PAPER)
    dim = design_camera(replace(PAPER, illuminance_lx=0.02 * bright.needed_illuminance_lx))
    assert dim.noise_levels > 5 * bright.noise_levels
    assert dim.position_sigma_m > bright.position_sigma_m
    assert "light the paper with" in only_warning(dim)


@given(st.floats(1e-3, 0.1), st.floats(0.2e-3, 2e-3))
def test_a_window_in_view_has_a_diagonal_that_fits(side_m: float, pitch_m: float) -> None:
    dots = window_in_view(side_m, pitch_m)
    if dots:
        assert window_diagonal_m(dots, pitch_m) <= side_m * (1 + 1e-6)
    assert window_diagonal_m(dots + 1, pitch_m) > side_m * (1 - 1e-6)


# ---- choices


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: sensor.name)
def test_a_suggested_camera_shows_the_wanted_dots(sensor: Sensor) -> None:
    setup = suggest_camera(sensor, speed_mps=0.3)
    report = design_camera(setup)
    assert report.window_dots == 12
    assert report.read_rate > 0.95
    assert setup.distance_m <= 0.02
    # The motion of a pixel of the paper's camera, 1/11 pitch.
    assert setup.motion_m <= setup.pitch_m / 11 * 1.001
    assert setup.exposure_s <= 1 / sensor.max_fps


def test_given_values_are_kept() -> None:
    setup = suggest_camera(MT9V034, focal_m=3.6e-3, distance_m=0.02, exposure_s=1e-4)
    assert (setup.lens.focal_m, setup.distance_m, setup.exposure_s) == (3.6e-3, 0.02, 1e-4)
    assert suggest_camera(MT9V034, distance_m=0.05).distance_m == 0.05
    assert design_camera(suggest_camera(MT9V034, focal_m=8e-3)).window_dots == 12


def test_dim_light_gets_a_longer_exposure() -> None:
    bright = suggest_camera(MT9V034, speed_mps=0.3)
    lux = design_camera(bright).needed_illuminance_lx
    dim = suggest_camera(MT9V034, speed_mps=0.3, illuminance_lx=lux / 2)
    assert dim.exposure_s == pytest.approx(2 * bright.exposure_s)
    darker = suggest_camera(MT9V034, speed_mps=0.3, illuminance_lx=lux / 100)
    assert darker.motion_m == pytest.approx(0.4 * darker.pitch_m)


def test_sensors_are_compared_and_reasons_are_given() -> None:
    fits = compare_sensors(SENSORS, speed_mps=0.3)
    assert [fit.fits for fit in fits] == sorted((fit.fits for fit in fits), reverse=True)
    by_name = {fit.sensor.name: fit for fit in fits}
    assert by_name["ov9281"].fits
    assert "rolling shutter" in by_name["ov2640"].reasons[0]
    assert sensor_named("OV9281") is by_name["ov9281"].sensor
    assert sensor_named("ov9999") is None


# ---- impossible wishes, and what would have to change


def test_too_few_dots() -> None:
    report = design_camera(replace(PAPER, distance_m=0.012))
    assert "only 5 x 5 dots" in report.warnings[0]
    assert "a distance of 15.8 mm" in report.warnings[0]
    assert design_camera(replace(PAPER, distance_m=0.0159)).window_dots == 8


def test_too_long_an_exposure() -> None:
    setup = replace(PAPER, speed_mps=1.0, yaw_rate_rps=20.0, exposure_s=2e-3)
    report = design_camera(setup)
    assert "expose at most" in report.warnings[0]
    assert report.max_exposure_s < 2e-3
    assert report.read_rate < 0.05
    shorter = design_camera(replace(setup, exposure_s=report.max_exposure_s * 0.99))
    assert shorter.read_rate > 0.9
    assert not any("expose at most" in warning for warning in shorter.warnings)


def test_too_shallow_a_depth_of_field() -> None:
    setup = replace(PAPER, focus_error_m=5e-3)
    assert "depth of field" in design_camera(setup).warnings[0]
    stopped = replace(setup, lens=Lens(5.5e-3, 8.0))
    assert not any("depth of field" in text for text in design_camera(stopped).warnings)


def test_a_rolling_shutter_at_speed() -> None:
    rolling = Sensor("slow", (188, 120), 24e-6, 30.0, "rolling")
    setup = replace(PAPER, sensor=rolling, binning=1, speed_mps=0.3, wanted_rate_hz=10.0)
    warning = only_warning(design_camera(setup))
    assert "shears the frame by 1.81" in warning
    slower = float(warning.partition("at most ")[2].split()[0])
    assert design_camera(replace(setup, speed_mps=0.95 * slower)).warnings == ()


def test_more_poses_than_frames() -> None:
    setup = replace(PAPER, wanted_rate_hz=200.0)
    assert "200 poses per second" in only_warning(design_camera(setup))
    assert frame_rate(setup) == 60


def test_too_much_light_and_too_short_an_exposure() -> None:
    setup = replace(PAPER, exposure_s=1e-6, illuminance_lx=1e7)
    report = design_camera(setup)
    assert any("exposes at least 20 us" in text for text in report.warnings)
    bright = replace(PAPER, illuminance_lx=10 * design_camera(PAPER).full_illuminance_lx)
    assert "overexposed 10.0 times" in only_warning(design_camera(bright))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"distance_m": -0.02}, "distance is -20 mm"),
        ({"distance_m": 20.0}, "distance is 20000 mm"),
        ({"distance_m": 0.005}, "cannot be focused"),
        ({"exposure_s": 0.0}, "exposure is 0"),
        ({"exposure_s": math.nan}, "exposure is nan"),
        ({"tilt_rad": 2.0}, "a tilt of 114.592 degrees"),
        ({"binning": 0}, "a binning of 0"),
        ({"speed_mps": -1.0}, "the speed is -1 m/s"),
        ({"jitter_m": math.nan}, "the jitter of the dots is nan um"),
        ({"noise_levels": 300.0}, "a noise of 300"),
        ({"dot_pitches": 0.7}, "dot pitches is 0.7"),
    ],
)
def test_values_out_of_range(change: dict[str, float], problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        replace(PAPER, **change)
    assert caught.value.hint


def test_sensors_and_lenses_out_of_range() -> None:
    for make in (
        lambda: Sensor("x", (0, 10), 3e-6, 60.0),
        lambda: Sensor("x", (10, 10), 3.0, 60.0),
        lambda: Sensor("x", (10, 10), 3e-6, 60.0, "slow"),
        lambda: Lens(0.0),
        lambda: Lens(5e-3, distortion=0.5),
        lambda: suggest_camera(MT9V034, window_dots=0),
        lambda: measure_camera(PAPER, 0),
    ):
        with pytest.raises(InputError):
            make()


# ---- against rendered frames


def test_frames_at_the_largest_tilt_need_little_memory() -> None:
    """Dots beside a tilted camera have infinite images, which must not be allocated."""
    tracemalloc.start()
    measured = measure_camera(suggest_camera(SENSORS[0], tilt_rad=math.pi / 4), 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert measured.read_rate == 1.0
    assert peak < 200e6


def test_the_predictor_does_not_load_the_simulator() -> None:
    code = (
        "import sys; from locatk.core.dots.design import camera; "
        "print([m for m in sys.modules if 'simulation' in m])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_camera_model_displaces_the_corner_by_the_distortion() -> None:
    camera = camera_model(PAPER)
    corner = np.zeros((1, 2))
    straight = camera.undistort(corner) - camera.centre_px
    bent = corner - camera.centre_px
    ratio = np.linalg.norm(bent) / np.linalg.norm(straight)
    assert ratio == pytest.approx(1 - PAPER.lens.distortion, abs=0.003)


@pytest.mark.parametrize(
    "setup",
    [
        replace(PAPER, speed_mps=0.5, tilt_rad=0.1),
        replace(PAPER, jitter_m=1e-6, noise_levels=6.0, lens_blur_m=20e-6),
    ],
)
def test_prediction_agrees_with_rendered_frames(setup: CameraSetup) -> None:
    report, measured = design_camera(setup), measure_camera(setup, 40, seed=3)
    assert measured.read_rate == 1.0
    assert report.position_sigma_m == pytest.approx(measured.position_rms_m, rel=0.25)
    assert report.heading_sigma_rad == pytest.approx(measured.heading_rms_rad, rel=0.35)


@pytest.mark.parametrize(
    "change",
    [
        {"lens_blur_m": MAX_BLUR_PITCHES * 0.508e-3 * PAPER.magnification},
        {"speed_mps": MAX_MOTION_PITCHES * 0.508e-3 * 7684},
    ],
    ids=["blur", "motion"],
)
def test_frames_at_the_limits_are_read(change: dict[str, float]) -> None:
    setup = replace(PAPER, focus_error_m=0.0, **change)
    assert design_camera(setup).read_rate > 0.95
    assert measure_camera(setup, 12, seed=5).read_rate == 1.0


@pytest.mark.parametrize("down", [False, True])
def test_frames_that_a_rolling_shutter_shears_are_read(down: bool) -> None:
    options = SimulationOptions(frames=12, path="random", camera=camera(0.0), seed=3)
    session = simulate(None, options)
    (width, height), matrix = options.camera.size, np.eye(2, 3)
    # Rows are displaced along x, or along y, in proportion to their time.
    matrix[int(down), 1] += MAX_SHEAR
    matrix[:, 2] = (np.eye(2) - matrix[:, :2]) @ [(width - 1) / 2, (height - 1) / 2]
    images = [
        cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_CONSTANT)
        for image in session.frames.images
    ]
    read = frames.localize_frames(np.stack(images), codec("anoto"), other_codec_odds=0)
    assert read.accepted.mean() > 0.9


SENSOR_SIZES = st.tuples(st.integers(40, 3000), st.integers(40, 3000))


@settings(max_examples=30, deadline=None)
@given(
    SENSOR_SIZES,
    st.floats(1e-6, 30e-6),
    st.floats(1e-3, 50e-3),
    st.floats(1.1, 50.0),
    st.floats(1e-6, 0.1),
    st.floats(0.1e-3, 3e-3),
    st.floats(0.0, 10.0),
)
def test_every_camera_has_a_report(
    size: tuple[int, int],
    pixel_m: float,
    focal_m: float,
    distance: float,
    exposure_s: float,
    pitch_m: float,
    speed_mps: float,
) -> None:
    setup = CameraSetup(
        Sensor("any", size, pixel_m, 60.0),
        Lens(focal_m),
        distance * focal_m,
        exposure_s,
        pitch_m=pitch_m,
        speed_mps=speed_mps,
    )
    report = design_camera(setup)
    assert 0 <= report.read_rate <= 1
    assert report.position_sigma_m > 0
    assert report.heading_sigma_rad > 0
    assert report.near_m <= setup.distance_m * (1 + 1e-9) <= report.far_m * (1 + 2e-9)
    # A camera of which no frame is read is never returned without a remedy.
    assert report.read_rate > 0.9 or any(": " in text for text in report.warnings)


def test_frames_that_cannot_be_read_are_predicted() -> None:
    blurred = replace(PAPER, lens_blur_m=0.4 * PAPER.pitch_m * PAPER.magnification)
    assert design_camera(blurred).read_rate < 0.05
    measured = measure_camera(blurred, 6)
    assert (measured.read, measured.read_rate) == (0, 0.0)
    assert math.isnan(measured.position_rms_m)


@pytest.mark.parametrize(
    "change",
    [
        {"exposure_s": 1.0, "speed_mps": 3.0},
        {"exposure_s": 1.0, "yaw_rate_rps": 100.0},
        {"lens_blur_m": 1.0},
        {"pitch_m": 0.05},
        {"pitch_m": 1e-6},
        {"distance_m": 9.9},
        {"distance_m": 0.0058},
        {"jitter_m": 1.0},
        {"noise_levels": 255.0},
        {"focus_error_m": 0.1},
    ],
)
def test_hopeless_cameras_are_answered_at_once(change: dict[str, float]) -> None:
    report = design_camera(replace(PAPER, **change))
    assert report.read_rate < 0.01
    assert report.warnings
