"""Calibration of simulated floors with installation errors and faults, compared with the truth.

The truth is that of the simulator (fields by magpylib, each bar displaced); the map that the
calibration receives contains none of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks import solver
from locatk.core.landmarks.calibration import datum
from locatk.core.landmarks.calibration.floor import (
    CalibrationDrive,
    FloorCalibrationReport,
    calibrate,
    read_drive,
)
from locatk.core.landmarks.calibration.landmarks import (
    describe_landmarks,
    flag_deviations,
    refusal_reason,
    sigma_without_prior,
)
from locatk.core.landmarks.landmark import signs
from locatk.core.landmarks.localization import smoothing
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.simulation import session as simulate
from locatk.core.landmarks.simulation.floor import InstalledLandmark, install_landmarks
from locatk.core.landmarks.simulation.session import (
    Errors,
    Faults,
    SimulatedSession,
    SimulationOptions,
)

CODES = np.array([[13, 5, 4, 12], [3, 7, 2, 15], [1, 11, 6, 8]])
FLOOR = FloorMap(CODES)
FAULTS = Faults(
    flipped=(((1, 1), 2), ((0, 3), 0)),
    missing=(((2, 2), 0),),
    displaced=(((0, 2), (0.006, -0.008)),),
)
ROWS = tuple((r, c if r % 2 == 0 else 3 - c) for r in range(3) for c in range(4))
COLUMNS = tuple((r if c % 2 == 0 else 2 - r, c) for c in range(4) for r in range(3))


def drive(
    cells: tuple[Cell, ...],
    seed: int,
    *,
    floor: FloorMap = FLOOR,
    floor_seed: int = 5,
    faults: Faults = FAULTS,
    errors: Errors | None = None,
) -> SimulatedSession:
    """A robot of its own on the floor of ``floor_seed``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            simulate, "install_landmarks", lambda f, e, x, _: install_landmarks(f, e, x, floor_seed)
        )
        return simulate.simulate(
            floor,
            SimulationOptions(
                strategy="path", cells=cells, seed=seed, faults=faults, errors=errors or Errors()
            ),
        )


def calibration_drive(
    session: SimulatedSession, name: str = "run", floor: FloorMap = FLOOR
) -> CalibrationDrive:
    result = read_drive(name, session.samples[0], session.odometry[0], floor)
    assert isinstance(result, CalibrationDrive)
    return result


@dataclass
class Case:
    floor_seed: int
    drives: list[CalibrationDrive]
    report: FloorCalibrationReport
    laid: dict[Cell, InstalledLandmark]


@pytest.fixture(scope="module")
def case() -> Case:
    """Two drives over twelve landmarks, by rows and by columns."""
    sessions = [drive(cells, 500 + k, floor_seed=5) for k, cells in enumerate((ROWS, COLUMNS))]
    drives = [calibration_drive(session, f"run{k}") for k, session in enumerate(sessions)]
    laid = {one.cell: one for one in sessions[0].installed_landmarks}
    return Case(5, drives, calibrate(FLOOR, drives), laid)


def middles(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (n, 2) as found, the true middles of the bars, and nominal places."""
    cells = [one.cell for one in case.report.landmarks]
    result = [[one.built.x_m, one.built.y_m] for one in case.report.landmarks]
    nominal = np.array([FLOOR.position(cell) for cell in cells])
    true = np.array([case.laid[cell].middle_m[:, :2].mean(axis=0) for cell in cells])
    return np.array(result) + nominal, true, nominal


def off_frame(error: np.ndarray, position: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
    """Errors ``at`` places less the motion that fits the errors at ``place`` best."""
    middle = position.mean(axis=0)

    def shape(points: np.ndarray) -> np.ndarray:
        off = points - middle
        one, zero = np.ones(len(off)), np.zeros(len(off))
        return np.stack(
            [np.stack([one, zero, -off[:, 1]], 1), np.stack([zero, one, off[:, 0]], 1)], 1
        )

    motion = np.linalg.lstsq(shape(position).reshape(-1, 3), error.ravel(), rcond=None)[0]
    if at is None:
        return error - shape(position) @ motion
    return -(shape(at) @ motion)


@pytest.mark.slow
def test_flags_are_exactly_the_faults(case: Case) -> None:
    flags = {one.cell: one.built.flags for one in case.report.landmarks if one.built.flags}
    assert flags == {
        (0, 2): ("displaced",),
        (0, 3): ("flipped:0",),
        (1, 1): ("flipped:2",),
        (2, 2): ("missing:0",),
    }
    assert case.report.unvisited == ()
    assert case.report.left_out == {}
    assert [one.refused for one in case.report.landmarks] == [""] * 12
    assert case.report.residual_sigma < 1.2


def test_centres_headings_and_strengths_are_the_true_ones(case: Case) -> None:
    result, true, nominal = middles(case)
    error = off_frame(result - true, nominal)
    assert np.hypot(*error.T).max() < 0.5e-3
    for one in case.report.landmarks:
        laid = case.laid[one.cell]
        assert one.built.visits == 2
        assert one.built.heading_rad == pytest.approx(laid.heading_rad, abs=math.radians(0.4))
        assert one.built.strength == pytest.approx(laid.strength, abs=0.02)
    before = off_frame(nominal - true, nominal)
    assert np.hypot(*before.T).max() > 5e-3


def test_standard_deviations_are_those_of_the_errors(case: Case) -> None:
    result, true, nominal = middles(case)
    error = off_frame(result - true, nominal)
    sigma = np.array([one.built.sigma for one in case.report.landmarks])
    # The bars' own places, of which the middle is told here, are in the sigmas too.
    assert 0.05 < np.mean((error / sigma[:, :2]) ** 2) < 1.5
    assert np.all(sigma[:, :2] < 0.5e-3)
    strength = np.array(
        [one.built.strength - case.laid[one.cell].strength for one in case.report.landmarks]
    )
    assert 0.2 < np.mean((strength / sigma[:, 3:]) ** 2) < 4


@pytest.mark.slow
def test_later_drives_are_solved_better_with_the_floor_as_built(case: Case) -> None:
    later = drive(ROWS[::-1][:8], 77, floor_seed=case.floor_seed)
    errors = {}
    result, true, nominal = middles(case)
    for floor, reported in ((FLOOR, nominal), (case.report.floor, result)):
        solution = solver.solve(later.samples, floor, None, odometry=later.odometry)
        (path,), truth = solution.trajectories, later.truth[0]
        at = np.column_stack(
            [
                np.interp(path.time_ns - truth.time_ns[0], truth.time_ns - truth.time_ns[0], axis)
                for axis in truth.position[:, :2].T
            ]
        )
        # A pose is one in the frame of the map: less how that lies on the true floor.
        sound = [
            n for n, one in enumerate(case.report.landmarks) if "displaced" not in one.built.flags
        ]
        frame = off_frame((reported - true)[sound], nominal[sound], at)
        errors[floor is FLOOR] = np.hypot(*(path.position[:, :2] - at + frame).T)
    assert errors[False].mean() < 0.4e-3
    assert errors[False].mean() < 0.6 * errors[True].mean()
    assert errors[False].max() < errors[True].max()


@pytest.mark.slow
def test_earlier_calibration_is_no_evidence(case: Case) -> None:
    wrong = {
        cell: replace(built, x_m=built.x_m + 0.004, strength=0.9 * built.strength)
        for cell, built in case.report.floor.built.items()
    }
    again = calibrate(replace(FLOOR, built=wrong), case.drives)
    for cell, built in case.report.floor.built.items():
        assert again.floor.built[cell].x_m == built.x_m
        assert np.array_equal(again.floor.built[cell].strength, built.strength)


@pytest.mark.slow
def test_outlier_visit_is_left_out(case: Case) -> None:
    """Its position deviates by 15 mm from odometry and the other visits."""
    first, second = case.drives
    visits = list(first.identified.visits)
    which = 5
    hypotheses = tuple(
        replace(one, pose=one.pose + [0.0, 0.015, 0.0])
        for one in visits[which].hypotheses.hypotheses
    )
    visits[which] = replace(
        visits[which], hypotheses=replace(visits[which].hypotheses, hypotheses=hypotheses)
    )
    report = calibrate(
        FLOOR, [replace(first, identified=replace(first.identified, visits=visits)), second]
    )
    (name,) = report.left_out
    assert name.startswith("run0 at ")
    cell = visits[which].cell
    assert report.left_out[name].startswith(f"the visit to {cell[0]},{cell[1]} ")
    count = {one.cell: one.built.visits for one in report.landmarks}
    assert count.pop(cell) == 1
    assert set(count.values()) == {2}


@pytest.mark.slow
def test_unconnected_parts_are_reported() -> None:
    rows = [drive(tuple((r, c) for c in range(4)), 30 + r, faults=Faults()) for r in (0, 2)]
    report = calibrate(FLOOR, [calibration_drive(session) for session in rows])
    assert report.unvisited == tuple((1, c) for c in range(4))
    assert "2 parts of the floor" in report.notes[0]
    for row in (0, 2):
        built = [report.floor.built[row, c] for c in range(4)]
        assert np.median([one.y_m for one in built]) == pytest.approx(0, abs=1e-3)
    assert set(report.floor.built) == {(r, c) for r in (0, 2) for c in range(4)}


@pytest.mark.slow
def test_position_of_the_whole_floor_is_not_observable() -> None:
    moved = Faults(displaced=tuple((cell, (0.008, 0.003)) for cell in FLOOR.cells()))
    cells = ROWS[:6]
    quiet = replace(Errors(), landmark_place_m=0.0, bar_place_m=0.0, landmark_turn_rad=0.0)
    report = calibrate(FLOOR, [calibration_drive(drive(cells, 40, faults=moved, errors=quiet))])
    for one in report.landmarks:
        assert np.hypot(one.built.x_m, one.built.y_m) < 1e-3
        assert "displaced" not in one.built.flags


@pytest.mark.slow
def test_uniformly_weaker_magnets_are_no_weak_bars() -> None:
    """By a quarter: that is taken for a wrong scale of the readings, which is reported."""
    strong = replace(FLOOR, geometry=replace(FLOOR.geometry, remanence_t=1.6))
    session = drive(ROWS[:2], 41, faults=Faults())
    report = calibrate(strong, [calibration_drive(session, floor=strong)])
    assert report.notes[0].startswith("run: robot: fields are about 0.7")
    assert report.strength == pytest.approx(1.0, abs=0.02)
    assert all(one.built.flags == () for one in report.landmarks)


def test_no_usable_recording() -> None:
    with pytest.raises(InputError, match=r"no landmark of the map .* \(a.mcap: not localised\)"):
        calibrate(FLOOR, [], {"a.mcap": "not localised"})
    session = drive(ROWS[:2], 42, faults=Faults())
    samples = session.samples[0]
    quiet = replace(samples, field_t=1e-5 * np.sign(samples.field_t))
    assert read_drive("a", quiet, session.odometry[0], FLOOR) == "no landmark was detected"
    other = FloorMap(np.zeros((1, 1), np.int64))
    assert read_drive("a", samples, session.odometry[0], other) == "not localised on the map"


# ---- flags


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({}, ()),
        ({"strength": [1, -1, -0.85, 1]}, ()),
        ({"strength": [1, -1, -0.75, 1]}, ("weak:2",)),
        ({"strength": [1, -1, -0.75, 1], "sigma": 0.1}, ()),
        ({"strength": [1, 0.9, -1, 1]}, ("flipped:1",)),
        ({"strength": [1, 0.5, -1, 1]}, ("flipped:1", "weak:1")),
        ({"strength": [1, 0.3, -1, 1], "sigma": 0.15}, ("weak:1",)),
        ({"strength": [0.2, -1, -1, -0.1]}, ("missing:0", "missing:3")),
        ({"left": [3e-3, 3e-3, 0]}, ()),
        ({"left": [4e-3, 4e-3, 0]}, ("displaced",)),
        ({"left": [4e-3, 4e-3, 0], "place": 2e-3}, ()),
        ({"left": [0, 0, -0.06]}, ("turned",)),
    ],
)
def test_flags(change: dict, wanted: tuple[str, ...]) -> None:
    sigma = np.full(7, change.get("place", 3e-4))
    sigma[3:] = change.get("sigma", 0.01)
    left = np.array(change.get("left", [0.0, 0.0, 0.0]))
    strength = np.array(change.get("strength", [1.0, -1.0, -1.0, 1.0]))
    assert flag_deviations(np.array([1.0, -1.0, -1.0, 1.0]), left, strength, sigma) == wanted


def test_single_landmark_has_bars_but_no_pose() -> None:
    pose = np.array([*FLOOR.position((1, 1)), 0.0]) + [3e-3, -2e-3, 0.01]
    strength = signs(CODES[1, 1])
    sigma = np.full(3, 0.01)
    smoothed = smoothing.SmoothingResult(
        [],
        {(1, 1): smoothing.LandmarkEstimate(pose, strength, np.diag([1e-4] * 3 + [1e-4] * 4))},
        0.9,
    )
    marks = {(1, 1): smoothing.LandmarkPrior(pose, sigma, strength, np.full(4, 0.5))}
    result = describe_landmarks(smoothed, marks, FLOOR, [[(1, 1)]], [])[1, 1]
    assert (result.built.x_m, result.built.y_m, result.built.heading_rad) == (0, 0, 0)
    assert np.isnan(result.built.sigma[:3]).all()
    assert np.array_equal(result.built.strength, strength)
    assert result.refused == ""


# ---- datum


def test_connected_components() -> None:
    assert datum.connected_components([[3, 1], [7], [1, 4], [9, 8], [4, 9]]) == [
        [1, 3, 4, 8, 9],
        [7],
    ]
    assert datum.connected_components([]) == []


def test_displaced_landmarks_do_not_bias_the_alignment() -> None:
    random = np.random.default_rng(1)
    design = np.column_stack([random.uniform(0, 1, (8, 2)), np.zeros(8)])
    off = np.zeros((8, 3))
    off[3] = [0.012, -0.009, 0.1]
    rotation = 0.004
    c, s = math.cos(rotation), math.sin(rotation)
    pose = design + off
    pose[:, :2] = pose[:, :2] @ [[c, s], [-s, c]] + [0.02, 0.03]
    pose[:, 2] += rotation
    left = datum.deviations_from_design(pose, design, np.array([1.5e-3, 1.5e-3, 0.012]))
    assert left == pytest.approx(off, abs=3e-4)


def test_relative_covariances_have_no_gauge_part() -> None:
    """Against the whole matrix: A has the motions as its null space, the priors are W."""
    random = np.random.default_rng(2)
    position = random.uniform(0, 1, (5, 2))
    motion = datum.gauge_motions(position).reshape(15, 3)
    rows = random.normal(size=(40, 15))
    rows -= rows @ motion @ np.linalg.pinv(motion)
    information = 1e6 * rows.T @ rows
    sigma = np.tile([0.01, 0.01, 0.08], (5, 1))
    sigma[2] *= 0.2
    inverse = np.linalg.inv(information + np.diag(sigma.ravel() ** -2.0))
    # Constrain the W-weighted mean motion of all landmarks to 0.
    held = motion.T @ np.diag(sigma.ravel() ** -2.0)
    whole = inverse - inverse @ held.T @ np.linalg.inv(held @ inverse @ held.T) @ held @ inverse
    blocks = np.array([inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(5)])
    own = datum.relative_covariances(4 * blocks, position, sigma, 4)
    for k in range(5):
        part = slice(3 * k, 3 * k + 3)
        assert own[k] == pytest.approx(4 * whole[part, part], rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("position_m", "strength", "reason"),
    [
        (1.4e-3, 0.14, ""),
        (1.6e-3, 0.14, "its pose is too uncertain"),
        (1.4e-3, 0.16, "the strength of bar 2 is too uncertain"),
        (np.nan, 0.14, ""),
    ],
)
def test_uncertain_landmarks_are_refused(position_m: float, strength: float, reason: str) -> None:
    sigma = np.array([position_m, 1e-4, 1e-3, 0.01, 0.01, strength, 0.01])
    assert refusal_reason(sigma) == reason


def test_standard_deviations_by_the_measurements_alone() -> None:
    prior, data = np.array([1.5, 0.04, 2.0]), np.array([0.9, 0.2, np.nan])
    posterior = 1 / np.sqrt(1 / prior**2 + 1 / data**2)
    assert sigma_without_prior(posterior, prior) == pytest.approx(data, nan_ok=True)
    assert sigma_without_prior(prior[:2], prior[:2]) == pytest.approx([np.inf, np.inf])
