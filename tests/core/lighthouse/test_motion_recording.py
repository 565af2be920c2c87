"""Long recordings: paths that are estimated part by part."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.geometry import umeyama
from locatk.core.lighthouse import solve
from locatk.core.lighthouse.motion import recording
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.lighthouse.flights import Flight, make_flight


def in_parts(monkeypatch: pytest.MonkeyPatch, flight: Flight, knots: int) -> Trajectory:
    """Return the trajectory of a flight whose scene is estimated from some of its knots."""
    monkeypatch.setattr(recording, "MAX_SAMPLE_KNOTS", knots)
    monkeypatch.setattr(recording, "SAMPLE_WINDOW_S", 2.0)
    monkeypatch.setattr(recording, "PART_S", 3.0)
    return solve_flight(flight)


def solve_flight(flight: Flight) -> Trajectory:
    solution = solve(flight.sweeps, flight.scene, receivers=flight.receivers)
    assert not [w for w in solution.warnings if w.code == "paths_not_estimated"]
    return solution.trajectories[0]


def errors(flight: Flight, trajectory: Trajectory, *, with_scale: bool = False) -> np.ndarray:
    """Return the distances (n,) from the true positions after alignment."""
    truth, _ = flight.true_poses(trajectory.time_ns)
    aligned = umeyama(trajectory.position, truth, with_scale=with_scale).apply(trajectory.position)
    return np.asarray(np.linalg.norm(aligned - truth, axis=1))


@pytest.mark.parametrize(("geometry", "diodes"), [("given", 4), ("unknown", 4), ("given", 1)])
def test_parts_are_as_accurate_as_the_whole(
    monkeypatch: pytest.MonkeyPatch, geometry: str, diodes: int
) -> None:
    flight = make_flight(7, duration_s=12.0, motion="slow", geometry=geometry, diodes=diodes)
    whole = solve_flight(flight)
    parts = in_parts(monkeypatch, flight, 700)
    assert np.array_equal(parts.time_ns, whole.time_ns)
    # Another path was estimated, with similar errors and covariances.
    assert not np.array_equal(parts.position, whole.position)
    # Given stations alone determine the scale of single photodiodes.
    error, expected = (errors(flight, t, with_scale=diodes == 1) for t in (parts, whole))
    assert np.median(error) < 1.3 * np.median(expected) + 5e-4
    assert np.max(error) < 1.5 * np.max(expected) + 2e-3
    ratio = parts.sigma[:, :3] / whole.sigma[:, :3]
    assert 0.8 < np.median(ratio) < 1.6
    # No jump where parts meet.
    step = np.linalg.norm(np.diff(parts.position, axis=0) - np.diff(whole.position, axis=0), axis=1)
    assert step.max() < 2e-3


def test_a_part_without_agreement_has_no_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = make_flight(7, duration_s=12.0, motion="slow", geometry="given")
    follow, calls = recording.follow_path, []

    def fail_once(*arguments: object, **options: object) -> recording.PathEstimate:
        calls.append(arguments)
        if len(calls) == 2:
            raise recording.DegenerateError("")
        return follow(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(recording, "follow_path", fail_once)
    trajectory = in_parts(monkeypatch, flight, 700)
    gap_s = 1e-9 * np.diff(trajectory.time_ns).max()
    assert 2.9 < gap_s < 3.1
    assert errors(flight, trajectory).max() < 0.01
