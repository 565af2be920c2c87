"""Guards of the localization of single photodiodes, each on its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.epochs import Epochs, rotor_angles
from locatk.core.lighthouse.localization.photodiodes import (
    MAX_JUMP_WINDOW_S,
    MAX_RANGE_M,
    _contradiction_warnings,
    angle_sigma,
    find_jumps,
    inlier_gate,
    leave_out_worst_station,
    restore_swapped_sweeps,
    track_photodiodes,
)
from locatk.core.lighthouse.localization.positions import (
    PositionEstimates,
    correct_angles,
    estimate_positions,
)
from locatk.core.lighthouse.noise import (
    ANGLE_SIGMA_RAD,
    INLIER_GATE_RAD,
    INLIER_GATE_SIGMAS,
    MIN_INLIER_GATE_RAD,
)
from locatk.core.lighthouse.scene import Scene, Station

Array = NDArray[np.float64]


def estimates_with(
    residual: Array, *, redundancy: int = 1, position: Array | None = None
) -> PositionEstimates:
    """Estimates with given residuals (m, s, 2)."""
    m = len(residual)
    return PositionEstimates(
        np.zeros((m, 3)) if position is None else position,
        np.tile(np.eye(3), (m, 1, 1)),
        residual,
        np.full(m, redundancy),
    )


def epochs_of(counts: Array, *, step_s: float = 0.1, labelled: bool = True) -> Epochs:
    m, s = counts.shape[:2]
    time_ns = np.rint(1e9 * step_s * np.arange(m)).astype(np.int64)
    channels = np.array([1, 2, 5, 16][:s])
    return Epochs(("robot",), time_ns, np.zeros(m, np.int64), channels, counts, labelled)


# ---- gate


@pytest.mark.parametrize(
    ("sigma", "gate"),
    [
        (1e-5, MIN_INLIER_GATE_RAD),
        (1e-4, MIN_INLIER_GATE_RAD),
        (5e-4, INLIER_GATE_SIGMAS * 5e-4),
        (3e-3, INLIER_GATE_RAD),
    ],
)
def test_the_gate_follows_the_noise_between_its_limits(sigma: float, gate: float) -> None:
    residual = np.zeros((4000, 2, 2))
    residual[:, 0, 0] = np.random.default_rng(0).normal(0, sigma, 4000)
    assert inlier_gate(estimates_with(residual)) == pytest.approx(gate, rel=0.06)


def test_gross_outliers_do_not_widen_the_gate() -> None:
    residual = np.zeros((4000, 2, 2))
    residual[:, 0, 0] = np.random.default_rng(0).normal(0, 5e-4, 4000)
    clean = inlier_gate(estimates_with(residual))
    residual[::3, 0, 0] = 0.3
    assert inlier_gate(estimates_with(residual)) == pytest.approx(clean, rel=0.05)


def test_epochs_without_redundancy_do_not_show_the_noise() -> None:
    residual = np.full((10, 2, 2), 1e-9)
    assert angle_sigma(estimates_with(residual, redundancy=0), np.ones(10, bool)) == (
        ANGLE_SIGMA_RAD
    )
    noisy = np.full((10, 2, 2), 1e-3)
    assert angle_sigma(estimates_with(noisy), np.ones(10, bool)) > 5 * ANGLE_SIGMA_RAD


# ---- jump filter


def path_with_jump(size: float, row: int = 20) -> Array:
    """A path of 10 mm a step that scatters by 1 mm, with one position off to the side."""
    path = np.stack([0.01 * np.arange(40), np.zeros(40), np.zeros(40)], axis=1)
    path += np.random.default_rng(3).normal(0.0, 1e-3, path.shape)
    path[row, 1] += size
    return path


def jumps_of(path: Array, redundancy: int = 1, step_s: float = 0.1) -> list[int]:
    """Return the positions of a path that are jumps."""
    angles = np.zeros((len(path), 1, 2))
    estimates = estimates_with(angles, redundancy=redundancy, position=path)
    found = find_jumps(epochs_of(angles, step_s=step_s), estimates, np.ones(len(path), bool))
    return np.flatnonzero(found).tolist()


@pytest.mark.parametrize("redundancy", [0, 1])
@pytest.mark.parametrize("row", [0, 1, 20, 39])
@pytest.mark.parametrize(("size", "is_jump"), [(0.003, False), (0.06, True), (1.0, True)])
def test_positions_far_from_the_path_are_jumps(
    size: float, is_jump: bool, row: int, redundancy: int
) -> None:
    found = jumps_of(path_with_jump(size, row), redundancy)
    assert found == ([row] if is_jump else [])


def test_two_wrong_positions_in_a_row_are_jumps() -> None:
    path = path_with_jump(0.3)
    path[21, 0] -= 0.4
    assert jumps_of(path) == [20, 21]


@pytest.mark.parametrize("speed", [0.003, 0.03, 0.1])
def test_starts_stops_and_corners_are_no_jumps(speed: float) -> None:
    # At rest for 80 % of the time, then a square at constant speed.
    steps = np.zeros((200, 3))
    for side, direction in enumerate([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)]):
        steps[150 + 10 * side : 160 + 10 * side] = speed * np.array(direction)
    path = np.cumsum(steps, axis=0)
    path += np.random.default_rng(3).normal(0.0, 2e-4, path.shape)
    assert jumps_of(path) == []


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_over_a_pause_a_position_is_not_a_jump(factor: float) -> None:
    # Three pairs of neighbours predict a position within three steps.
    found = jumps_of(path_with_jump(1.0), 0, step_s=factor * MAX_JUMP_WINDOW_S / 3)
    assert bool(found) == (factor < 1)


# ---- contradictions


def factory_stations(world: Any, lamps: Any) -> tuple[Station, ...]:
    """Stations with the exact calibration of the lamps."""
    names = ("phase", "tilt", "curve", "gibmag", "gibpha", "ogeemag", "ogeephase")
    return tuple(
        Station(
            lamp.channel,
            lamp.position,
            lamp.rotation,
            Calibration(np.array([[getattr(p, n) for n in names] for p in lamp.planes]), "factory"),
        )
        for lamp in lamps
    )


def stack(stations: tuple[Station, ...]) -> Any:
    return (
        np.stack([s.position for s in stations]),
        np.stack([s.rotation for s in stations]),
        tuple(s.calibration for s in stations),
    )


def test_the_station_that_contradicts_is_left_out(world: Any) -> None:
    lamps = world.lamps(1, 2, 5, 16)
    points = world.curve(50, flat=False)
    angles = np.stack([lamp.angles(points) for lamp in lamps], axis=1)
    angles[10, 2] += 0.05
    angles[20, 1:3] += 0.05  # Two wrong stations: no single one explains it.
    stations = stack(factory_stations(world, lamps))
    estimates = estimate_positions(angles, *stations)
    ideal = correct_angles(angles, stations[2])
    repaired, count = leave_out_worst_station(ideal, estimates, stations, None, 2e-3)
    assert count == 1
    np.testing.assert_allclose(repaired.position[10], points[10], atol=1e-4)
    assert np.isnan(repaired.residual[10, 2]).all()
    assert repaired.max_residual[20] > 2e-3
    others = np.delete(np.arange(50), [10, 20])
    np.testing.assert_array_equal(repaired.position[others], estimates.position[others])


def test_a_repair_that_nothing_checks_is_none(world: Any) -> None:
    """Without a third of the stations, two planes and a single one fit by themselves."""
    plain = (world.Plane(tilt=-0.049), world.Plane(tilt=0.046))
    lamps = tuple(replace(lamp, planes=plain) for lamp in world.lamps(1, 2, 5))
    angles = np.stack([lamp.angles(world.curve(5, flat=False)) for lamp in lamps], axis=1)
    angles[2, 1] += 0.05
    stations = stack(factory_stations(world, lamps))
    whole = leave_out_worst_station(
        correct_angles(angles, stations[2]),
        estimate_positions(angles, *stations),
        stations,
        None,
        2e-3,
    )
    assert whole[1] == 1
    # Six planes: redundancy 3. With the second plane of two stations missing, four are left after
    # the repair of one, or three, which always intersect.
    angles[2, 2, 1] = np.nan
    estimates = estimate_positions(angles, *stations)
    forced = replace(estimates, redundancy=estimates.redundancy + 1)
    ideal = correct_angles(angles, stations[2])
    _, count = leave_out_worst_station(ideal, forced, stations, None, 2e-3)
    assert count == 0


def test_two_stations_cannot_outvote_each_other(world: Any) -> None:
    lamps = world.lamps(1, 2)
    angles = np.stack([lamp.angles(world.curve(5, flat=True)) for lamp in lamps], axis=1)
    angles[2, 0] += 0.05
    stations = stack(factory_stations(world, lamps))
    estimates = estimate_positions(angles, *stations, floor_z=0.0)
    ideal = correct_angles(angles, stations[2])
    assert leave_out_worst_station(ideal, estimates, stations, 0.0, 2e-3)[1] == 0


@pytest.mark.parametrize("labelled", [True, False])
def test_only_reports_without_polynomials_are_restored(world: Any, labelled: bool) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(30, flat=True)
    counts = np.stack([lamp.counts(lamp.angles(points)) for lamp in lamps], axis=1)
    swapped = counts.copy()
    swapped[7] = counts[7, ::-1]
    swapped[8, :, 0] = counts[8, ::-1, 0]
    epochs = epochs_of(swapped, labelled=labelled)
    scene = Scene(factory_stations(world, lamps), planar=True, scale="markers")
    tracks = track_photodiodes(epochs, scene)
    assert tracks.restored_epochs == (0 if labelled else 2)
    assert len(tracks.trajectories[0]) == (28 if labelled else 30)
    if not labelled:
        np.testing.assert_array_equal(tracks.epochs.counts, counts)


def test_epochs_that_no_exchange_explains_stay_as_they_are(world: Any) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(30, flat=True)
    counts = np.stack([lamp.counts(lamp.angles(points)) for lamp in lamps], axis=1)
    counts[7, 1] += 900.0
    epochs = epochs_of(counts, labelled=False)
    stations = stack(factory_stations(world, lamps))
    estimates = estimate_positions(rotor_angles(epochs), *stations, floor_z=0.0)
    same, _, restored = restore_swapped_sweeps(epochs, estimates, stations, 0.0)
    assert restored == 0
    np.testing.assert_array_equal(same.counts, counts)


@pytest.mark.parametrize("scale", ["markers", "unit"])
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_the_range_is_limited_in_metres_only(world: Any, factor: float, scale: str) -> None:
    (lamp,) = world.lamps(1)
    direction = lamp.rotation @ np.array([1.0, 0.05, 0.02])
    point = lamp.position + factor * MAX_RANGE_M * direction / np.linalg.norm(direction)
    counts = lamp.counts(lamp.angles(point[None]))[None]
    scene = Scene(
        factory_stations(world, (lamp,)), planar=True, floor_z=float(point[2]), scale=scale
    )
    tracks = track_photodiodes(epochs_of(counts), scene)
    is_rejected = factor > 1 and scale == "markers"
    assert tracks.rejected == ({"moment_out_of_reach": 1} if is_rejected else {})


@pytest.mark.parametrize(("error_rad", "is_restored"), [(3e-3, True), (1.5e-2, False)])
def test_an_exchange_must_fit_well_to_be_undone(
    world: Any, error_rad: float, is_restored: bool
) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(30, flat=True), noise_rad=0.0)
    drive.turned(np.array([7]), 0, 0, np.array([error_rad]))
    counts = drive.counts.copy()
    counts[7] = drive.counts[7, ::-1]
    epochs = epochs_of(counts, labelled=False)
    stations = stack(factory_stations(world, lamps))
    estimates = estimate_positions(rotor_angles(epochs), *stations, floor_z=0.0)
    _, restored, count = restore_swapped_sweeps(epochs, estimates, stations, 0.0)
    assert count == int(is_restored)
    # The correct assignment is within the gate in both cases, and within half of it in the first.
    exact = estimate_positions(
        rotor_angles(epochs_of(drive.counts, labelled=False)), *stations, floor_z=0.0
    )
    assert exact.max_residual[7] < INLIER_GATE_RAD
    assert (restored.max_residual[7] < INLIER_GATE_RAD / 2) is np.bool_(is_restored)


@pytest.mark.parametrize(("inconsistent", "warns"), [(20, False), (21, True)])
def test_a_fifth_of_the_epochs_may_contradict_the_scene(inconsistent: int, warns: bool) -> None:
    warnings = _contradiction_warnings(inconsistent, 100)
    assert [w.code for w in warnings] == ["scene_contradicted"] * warns
    # Without a solved epoch there is nothing that contradicts.
    assert _contradiction_warnings(0, 0) == []
