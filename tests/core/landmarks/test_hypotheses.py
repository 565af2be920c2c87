"""Hypotheses of one visit: codes, probabilities and poses against simulated truth; guards."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.detection import hypotheses
from locatk.core.landmarks.detection.fit import ModelPriors, ParameterLayout
from locatk.core.landmarks.detection.hypotheses import (
    DetectedVisit,
    Hypothesis,
    LandmarkFit,
    VisitHypotheses,
    _rotate_frames,
    check_gains,
    detect_landmark,
    detect_visits,
    estimate_pose_at_known_landmark,
    find_faulty_sensor,
    fit_landmarks,
    robot_pose,
)
from locatk.core.landmarks.detection.trace import Trace
from locatk.core.landmarks.field import basis
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.landmark import Geometry, rotated, signs
from locatk.core.landmarks.localization.smoothing import constant_error_information
from locatk.core.landmarks.preprocessing import (
    HallRecording,
    VisitSegment,
    preprocess,
    segment_visits,
)
from locatk.core.landmarks.simulation.options import NONE
from locatk.core.landmarks.simulation.passes import SinglePass, simulate_passes

Array = NDArray[np.float64]

GEOMETRY = Geometry()


@dataclass(frozen=True)
class PassReading:
    """One pass: fits, and true code and error."""

    trace: Trace
    found: list[LandmarkFit]
    right: int
    error: Array
    covariance: Array


def read_pass(one: SinglePass, geometry: Geometry = GEOMETRY) -> PassReading | None:
    run = preprocess(one.samples, one.odometry)
    priors = ModelPriors(noise_t=run.noise_t)
    visits = segment_visits(run, geometry, priors.drift)
    if not visits:
        return None
    visit = visits[0]
    found = fit_landmarks(visit.trace, geometry, priors)
    if not found:
        return None
    observed, covariance = robot_pose(visit.trace, found[0], visit.trace.reference)
    since = one.truth.time_ns - visit.time_ns[visit.trace.reference]
    heading = np.unwrap(heading_from_quaternion(one.truth.quaternion))
    x, y, true_heading = (
        np.interp(0, since, column) for column in (*one.truth.position[:, :2].T, heading)
    )
    # The frame of the fit is the landmark's up to quarter turns.
    quarters = round((true_heading - observed[2]) / (math.pi / 2))
    rotation = quarters * math.pi / 2
    c, s = math.cos(rotation), math.sin(rotation)
    error = observed - [c * x + s * y, c * y - s * x, true_heading - rotation]
    return PassReading(visit.trace, found, int(rotated(one.code, -quarters)), error, covariance)


@functools.cache
def nominal() -> list[PassReading]:
    several = [read_pass(one) for one in simulate_passes(48, seed=21)]
    return [one for one in several if one is not None]


@pytest.mark.slow
@pytest.mark.parametrize("code", range(16))
def test_codes_of_traces_without_errors(code: int) -> None:
    one = read_pass(simulate_passes(1, code, errors=NONE, seed=5, start=(0.7 * code, 0.1))[0])
    assert one is not None
    assert one.found[0].code == one.right
    assert one.found[0].probability > 0.99
    assert np.hypot(*one.error[:2]) < 2e-4
    assert abs(one.error[2]) < 5e-3


@pytest.mark.slow
def test_one_pass_with_nominal_errors() -> None:
    """The figures of the project: 1.5 mm on average, 3 mm for 95 %, 92 % of the patterns."""
    errors = np.array([np.hypot(*one.error[:2]) for one in nominal()])
    assert len(errors) > 36
    assert errors.mean() < 1.5e-3
    assert np.quantile(errors, 0.95) < 3e-3
    assert np.mean([one.found[0].code == one.right for one in nominal()]) > 0.92


@pytest.mark.slow
def test_probabilities_are_calibrated() -> None:
    probability = np.array([one.found[0].probability for one in nominal()])
    right = np.array([one.found[0].code == one.right for one in nominal()])
    assert right[probability > 0.99].all()
    assert abs(probability.mean() - right.mean()) < 0.06
    for one in nominal():
        assert math.fsum(e.probability for e in one.found) == pytest.approx(1, abs=1e-6)
        assert [e.probability for e in one.found] == sorted(
            (e.probability for e in one.found), reverse=True
        )


@pytest.mark.slow
def test_covariances_agree_with_the_errors() -> None:
    squares = [
        one.error @ np.linalg.solve(one.covariance, one.error)
        for one in nominal()
        if one.found[0].code == one.right
    ]
    assert 1.2 < np.mean(squares) < 4.5


@pytest.mark.slow
def test_weak_magnets_are_not_misread_with_certainty() -> None:
    weak = Geometry(remanence_t=0.4, threshold_t=1.1e-3)
    for one in simulate_passes(15, geometry=weak, seed=22):
        got = read_pass(one, weak)
        if got is not None and got.found[0].probability > 0.99:
            assert got.found[0].code == got.right


@pytest.mark.slow
def test_spin_determines_code_and_pose() -> None:
    for one in simulate_passes(8, then="spin", seed=23):
        got = read_pass(one)
        assert got is not None
        assert got.found[0].code == got.right
        assert got.found[0].probability > 0.98
        assert np.hypot(*got.error[:2]) < 1.5e-3


def test_missing_bar_leaves_both_codes() -> None:
    one = simulate_passes(1, 0b0111, then="spin", errors=NONE, seed=3)[0]
    whole = read_pass(one)
    assert whole is not None
    bar = next(k for k in range(4) if whole.found[0].strength[k] < 0)
    without_bar = replace(
        whole.trace,
        field_t=whole.trace.field_t - field_of_bar(whole, bar),
    )
    found = fit_landmarks(without_bar, GEOMETRY, ModelPriors(noise_t=2e-5))
    assert found[0].faulty_bar == bar
    assert abs(found[0].strength[bar]) < 0.1
    probability = {e.code: e.probability for e in found}
    assert probability[0b1111] == pytest.approx(0.5, abs=0.05)
    assert probability[whole.found[0].code] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("toward", [-0.8, -0.1, 0.0, 0.7, 0.79, 1.2])
def test_rotated_frames_give_equal_fields(toward: float) -> None:
    rng = np.random.default_rng(1)
    parameters = rng.uniform(-3, 3, (20, 5))
    strength = rng.choice([-1.0, 0.0, 1.0], (20, 4))
    bars, rotated_parameters = _rotate_frames(strength, parameters, toward)
    assert np.abs(rotated_parameters[:, 2] - toward).max() <= math.pi / 4 + 1e-12
    assert (rotated_parameters[:, [0, 1, 3, 4]] == parameters[:, [0, 1, 3, 4]]).all()
    points = rng.uniform(-0.05, 0.05, (7, 2))
    for k in range(20):
        fields = [
            basis(GEOMETRY, in_frame(angle, points)) @ installed
            for angle, installed in (
                (parameters[k, 2], strength[k]),
                (rotated_parameters[k, 2], bars[k]),
            )
        ]
        assert fields[0] == pytest.approx(fields[1], abs=1e-12)


def in_frame(angle: float, points: Array) -> Array:
    """Points (n, 2) in a frame that is turned by an angle."""
    c, s = math.cos(angle), math.sin(angle)
    return points @ np.array([[c, -s], [s, c]])


def field_of_bar(one: PassReading, bar: int) -> Array:
    """What one bar adds to a trace, laid as it was read."""
    mark = one.found[0].parameters[:3]
    local = in_frame(mark[2], one.trace.sensor_positions() - mark[:2])
    return np.asarray(one.found[0].strength[bar] * basis(GEOMETRY, local)[..., bar])


def test_pose_at_known_landmark_at_rest() -> None:
    """To a millimetre, as the paper says of four voltages (4.1), and to what it tells.

    Under some headings, with a sensor over no bar, the heading shows little.
    """
    sizes, squares = [], []
    for one in simulate_passes(12, 0b0111, then="stand", aim_m=0.002, seed=24):
        run = preprocess(one.samples, one.odometry)
        still = slice(len(run.samples) - 20, None)
        value = (run.samples.field_t - run.offset_t)[still].mean(axis=0)[None]
        trace = Trace(
            np.zeros((1, 3)),
            np.zeros((1, 3, 6)),
            value,
            run.samples.sensors.position_m,
            np.array([20.0]),
            0,
        )
        quarters = round(one.end[2] / (math.pi / 2))
        rotation = quarters * math.pi / 2
        c, s = math.cos(rotation), math.sin(rotation)
        x, y, heading = one.end
        true = np.array([c * x + s * y, c * y - s * x, heading - rotation])
        near = true + [0.004, -0.003, 0.08]
        installed = signs(rotated(0b0111, -quarters))
        observed, spread = estimate_pose_at_known_landmark(
            trace, GEOMETRY, ModelPriors(noise_t=run.noise_t), installed, near
        )
        sizes.append(np.hypot(*(observed - true)[:2]))
        squares.append((observed - true) @ np.linalg.solve(spread, observed - true))
    assert np.mean(sizes) < 1e-3
    assert 0.5 < np.mean(squares) < 5


@pytest.mark.slow
def test_covariance_of_robot_pose() -> None:
    """By differences of the pose by each parameter."""
    one = nominal()[0]
    best = one.found[0]
    at = 3
    slope = []
    for k in range(len(best.parameters)):
        step = np.zeros(len(best.parameters))
        step[k] = 1e-6
        ahead, behind = (
            robot_pose(one.trace, replace(best, parameters=best.parameters + sign * step), at)[0]
            for sign in (1, -1)
        )
        slope.append((ahead - behind) / 2e-6)
    own = np.array(slope).T @ best.covariance @ np.array(slope)
    np.testing.assert_allclose(robot_pose(one.trace, best, at)[1], own, rtol=1e-5, atol=1e-14)


# ---- guards


def line_trace(bins: int = 5) -> Trace:
    """Return a straight pass without usable odometry errors."""
    pose = np.column_stack([np.linspace(-0.02, 0.02, bins), np.zeros(bins), np.zeros(bins)])
    field = np.arange(4.0 * bins).reshape(bins, 4)
    return Trace(pose, np.zeros((bins, 3, 6)), field, circle(), np.ones(bins), bins // 2)


def fit_of(
    residual_sigma: float = 1.0, gain_sigmas: tuple[float, ...] = (0, 0, 0, 0)
) -> LandmarkFit:
    """Return a fit of the code 5 at the origin."""
    layout = ParameterLayout.of(4, 6)
    parameters = np.zeros(layout.size)
    parameters[layout.gain] = gain_sigmas
    return LandmarkFit(
        5,
        0.0,
        parameters,
        1e-6 * np.eye(layout.size),
        signs(5),
        np.ones(4),
        residual_sigma,
        -1,
        1.0,
    )


def segment_of(first: int = 0, bins: int = 5, field_t: float = 5e-3) -> VisitSegment:
    time_ns = np.arange(first, first + bins, dtype=np.int64)
    trace = replace(line_trace(bins), field_t=np.full((bins, 4), field_t))
    return VisitSegment(first, first + bins, time_ns, trace, np.zeros(3))


def recording_of() -> HallRecording:
    samples = HallSamples("robot", HallSensors(), np.arange(9, dtype=np.int64), np.ones((9, 4)))
    return HallRecording(samples, np.zeros((9, 3)), np.zeros(4), 1e-4)


@pytest.mark.parametrize(("gain_sigmas", "warned"), [(3.9, False), (4.1, True), (-4.1, True)])
def test_deviating_gain_is_reported(gain_sigmas: float, warned: bool) -> None:
    fits = [fit_of(gain_sigmas=(0, 0, gain_sigmas, 0))] * 3
    warnings = check_gains(fits, recording_of(), ModelPriors())
    assert [each.code for each in warnings] == ["sensor_gain"] * warned
    assert all("rear sensor" in each.message for each in warnings)


def test_gains_of_fits_that_do_not_fit_are_not_reported() -> None:
    fit = fit_of(gain_sigmas=(0, 0, 10, 0))
    poor = replace(fit, residual_sigma=3.0)
    assert check_gains([fit, fit, poor], recording_of(), ModelPriors())
    assert not check_gains([fit, poor, poor], recording_of(), ModelPriors())


def test_negative_gain_is_an_error() -> None:
    fits = [fit_of(gain_sigmas=(0, -1.1 / ModelPriors().gain, 0, 0))]
    with pytest.raises(InputError, match="left sensor of robot has the opposite sign"):
        check_gains(fits, recording_of(), ModelPriors())


@pytest.mark.parametrize(
    ("bins", "field_t", "fits", "refused"),
    [
        (4, 5e-3, [fit_of(5.9)], ""),
        (4, 5e-3, [fit_of(6.1)], "not_explained"),
        (4, 5e-3, [], "not_explained"),
        (4, 1e-3, [], "too_weak"),
        (3, 5e-3, [fit_of(1.0)], "too_short"),
    ],
)
def test_visits_are_refused_with_a_reason(
    bins: int,
    field_t: float,
    fits: list[LandmarkFit],
    refused: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(hypotheses, "fit_landmarks", lambda *_: fits)
    segment = segment_of(bins=bins, field_t=field_t)
    visit = detect_landmark(segment, recording_of(), GEOMETRY, ModelPriors())
    assert visit.refused == refused
    assert bool(visit.hypotheses) == (bool(fits) and refused in ("", "not_explained"))


@pytest.mark.parametrize(
    ("as_given", "without_rear", "faulty"),
    [(20.0, 5.0, 2), (14.0, 5.0, None), (30.0, 6.5, None)],
)
def test_sensor_is_left_out_only_if_that_explains_the_visits(
    as_given: float, without_rear: float, faulty: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fits(trace: Trace, *_: object, thorough: bool) -> list[LandmarkFit]:
        assert not thorough
        is_without_rear = np.isnan(trace.field_t[:, 2]).all()
        return [fit_of(without_rear if is_without_rear else as_given)]

    monkeypatch.setattr(hypotheses, "fit_landmarks", fits)
    visit = VisitHypotheses("robot", 0, 0, 5, np.zeros(3), (), as_given, "not_explained")
    visits = [DetectedVisit(segment_of(), visit)]
    assert find_faulty_sensor(visits, recording_of(), GEOMETRY, ModelPriors()) == faulty


@pytest.mark.parametrize("explained", [2, 3])
def test_sensors_are_checked_only_if_many_visits_are_unexplained(
    explained: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    monkeypatch.setattr(
        hypotheses, "fit_landmarks", lambda *_, **__: calls.append(1) or [fit_of(20.0)]
    )
    visits = [
        DetectedVisit(
            segment_of(), VisitHypotheses("robot", 0, 0, 5, np.zeros(3), (), refused=refused)
        )
        for refused in ["not_explained"] + [""] * explained
    ]
    assert find_faulty_sensor(visits, recording_of(), GEOMETRY, ModelPriors()) is None
    assert bool(calls) == (explained == 2)


@pytest.mark.parametrize(("distance_m", "count"), [(0.039, 1), (0.041, 2)])
def test_successive_visits_to_one_landmark_are_merged(
    distance_m: float, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def detected(segment: VisitSegment, *_: object) -> VisitHypotheses:
        odometry = np.array([distance_m * (segment.first > 0), 0.0, 0.0])
        one = Hypothesis(5, 1.0, np.zeros(3), np.eye(3), signs(5), np.ones(4))
        return VisitHypotheses("robot", 0, segment.first, segment.stop, odometry, (one,))

    monkeypatch.setattr(hypotheses, "segment_visits", lambda *_: [segment_of(0), segment_of(5)])
    monkeypatch.setattr(hypotheses, "merge_segments", lambda *_: segment_of(0, 10))
    monkeypatch.setattr(hypotheses, "detect_landmark", detected)
    visits = detect_visits(recording_of(), GEOMETRY, ModelPriors(), 0.2)
    assert len(visits) == count
    assert visits[0].segment.stop == (10 if count == 1 else 5)


def test_alternative_wirings_are_named_together() -> None:
    given, ones = (0, 1, 2, 3), (1.0, 1.0, 1.0, 1.0)
    names = ("front", "left", "rear", "right")
    inverted = hypotheses.SensorChange(given, (1.0, 1.0, -1.0, 1.0))
    exchanged = hypotheses.SensorChange((2, 1, 0, 3), ones)
    one = hypotheses.wiring_error([inverted], names, "robot")
    assert "the rear sensor of robot has the opposite sign of the others" in str(one)
    both = hypotheses.wiring_error([exchanged, inverted], names, "robot")
    assert "are rear, left, front, right; or the rear sensor" in str(both)
    assert both.hint is not None
    assert "more landmarks" in both.hint


@pytest.mark.parametrize(("variance", "expected"), [(0.25, 3.0), (1.0, 0.0), (4.0, 0.0)])
def test_poor_fits_say_nothing_of_the_odometry(variance: float, expected: float) -> None:
    """Where the posterior of a fit is wider than the prior, it is no evidence."""
    layout = ParameterLayout.of(4, 6)
    parameters = np.full(layout.size, 0.5)
    fit = replace(fit_of(), covariance=variance * np.eye(layout.size), parameters=parameters)
    trace = replace(line_trace(5), field_t=np.zeros((5, 4)), correction=np.zeros((5, 3, 6)))
    information, vector = constant_error_information([(fit, trace)])
    np.testing.assert_allclose(information[0], expected * np.eye(4), atol=1e-12)
    np.testing.assert_allclose(vector[0], 0.5 / variance if expected else 0.0, atol=1e-12)


def test_covariances_of_poor_fits_grow_with_correlated_residuals() -> None:
    covariance = np.diag([1e-6, 4e-6])
    scores = np.zeros((40, 4, 2))
    scores[..., 0] = np.random.default_rng(0).normal(size=(40, 4))
    white = hypotheses.widened_covariance(covariance, scores, 1.5)
    scores[:, 1, 1] = 2e3
    correlated = hypotheses.widened_covariance(covariance, scores, 1.5)
    np.testing.assert_allclose(np.diag(white), 1.5**2 * np.diag(covariance))
    assert correlated[0, 0] == pytest.approx(white[0, 0])
    # Four clusters of ten scores of one sign, and the factor n / (n - 1) of 16 clusters.
    assert correlated[1, 1] == pytest.approx((4e-6 * 2e4) ** 2 * 4 * 16 / 15)
