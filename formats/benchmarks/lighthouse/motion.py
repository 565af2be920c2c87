"""Figures of devices in motion: simulated flights with known truth.

Most flights are those of :mod:`~locatk.formats.benchmarks.lighthouse.flights`, which shares nothing
with the solver; two cases are of the simulator of ``locatk simulate lighthouse``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from locatk.core.errors import LocatkError
from locatk.core.lighthouse import solve
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.simulation import SimulationOptions, simulate
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.lighthouse.flight_scores import (
    FAR_M,
    FlightScore,
    TruePoses,
    exceeds_sigmas,
    score_flight,
    score_trajectory,
    summarize,
)
from locatk.formats.benchmarks.lighthouse.flights import make_flight
from locatk.formats.benchmarks.timing import FIRST_SEED

FLIGHT_S = 22.0
"""Duration of a flight, with four seconds at rest on the floor [s]."""

MAX_TRUTH_GAP_NS = 15_000_000
"""Largest distance in time from a pose to a sample of the truth that is compared with it [ns]."""

Options = Mapping[str, Any] | SimulationOptions
"""Options of a flight: those of ``FlightOptions`` in ``flights`` by name, or of the simulator."""


@dataclass(frozen=True)
class Case:
    """Flights whose poses are scored together.

    Attributes
    ----------
    name, how : str
    flights : tuple of Options
        Those of the independent generator, or of the simulator of ``locatk simulate lighthouse``.
    nees : str
        Frame in which errors are compared with covariances, as described in
        :mod:`~locatk.formats.benchmarks.lighthouse.flight_scores`.
    alignment : str
        ``"rigid"``, ``"similarity"`` or ``"no"``.
    is_precise : bool
        True if the errors have targets: those of the deck in its own scene.
    """

    name: str
    how: str
    flights: tuple[Options, ...]
    nees: str = "aligned"
    alignment: str = "rigid"
    is_precise: bool = False


def _vary(flights: tuple[Mapping[str, Any], ...], **options: Any) -> tuple[Mapping[str, Any], ...]:
    return tuple({**flight, **options} for flight in flights)


SLOW, AGILE = {"motion": "slow"}, {"motion": "agile"}
FOUR_DIODES = _vary(({"motion": "hover"}, SLOW, AGILE, {"motion": "hand"}), geometry="unknown")
FAULTY = _vary((SLOW, AGILE), geometry="unknown")

FLOWN = SimulationOptions(
    planar=False,
    flying=True,
    receiver=DECK,
    report_hz=120.0,
    duration_s=36.0,
    outliers=0.05,
    noise_rad=ANGLE_SIGMA_RAD,
    reflections=0.05,
    calibration_error_rad=1e-3,
    factory_data=True,
)
REPORTED = SimulationOptions(
    planar=False, duration_s=60.0, outliers=0.1, noise_rad=ANGLE_SIGMA_RAD
)  # fmt: skip

CASES = (
    Case("four diodes", "hovering, slow, agile, by hand; stations unknown", FOUR_DIODES,
         is_precise=True),
    Case("four diodes, markers", "the same flights after rests on four measured markers",
         _vary(FOUR_DIODES, has_markers=True, duration_s=32.0), "raw", is_precise=True),
    Case("four diodes, stations given", "the same flights; stations off by 10 mm and 3 mrad",
         _vary(FOUR_DIODES, geometry="given"), "raw"),
    Case("one diode", "slow and agile; stations unknown", _vary(FAULTY, diodes=1), "aligned",
         "similarity"),
    Case("one diode, stations given", "the same flights; stations off by 10 mm and 3 mrad",
         _vary(FAULTY, diodes=1, geometry="given"), "raw"),
    Case("10 % wrong sweeps", "four diodes, stations unknown", _vary(FAULTY, wrong=0.1)),
    Case("10 % wrong sweeps, one diode", "stations given",
         _vary(FAULTY, wrong=0.1, diodes=1, geometry="given"), "raw"),
    Case("reflections", "four diodes, stations unknown; 8 % of the time, in runs",
         _vary(FAULTY, reflections=0.08)),
    Case("occlusion", "four diodes, stations unknown; each station is hidden for 25 % of the time",
         _vary(FAULTY, occlusion=0.25)),
    Case("moved station", "four diodes, stations given; one is displaced by 50 mm and 2 degrees",
         _vary(FAULTY, geometry="given", is_station_moved=True), "raw"),
    Case("own simulator", "four diodes, markers; factory data off by 1 mrad, 5 % wrong sweeps, "
         "5 % of the time in reflections", (FLOWN,) * 2, "raw", "no"),
    Case("10 reports a second", "own simulator, one diode, markers; 10 % wrong sweeps",
         (REPORTED,) * 2, "raw", "no"),
)  # fmt: skip


def motion_figures() -> list[Figure]:
    """Return the figures of all cases."""
    rows: list[Figure] = []
    pooled: list[FlightScore] = []
    for case in CASES:
        scores, refused = [], []
        for k, flight in enumerate(case.flights):
            try:
                scores.append(_score(flight, FIRST_SEED + k, case))
            except LocatkError as error:
                refused.append(str(error))
        rows += case_figures(case, scores, refused)
        pooled += scores
    invalid = sum(int(np.count_nonzero(score.is_invalid)) for score in pooled)
    how = f"of {sum(map(len, pooled))} poses of all flights"
    return [*rows, Figure("motion: poses without a valid covariance", invalid, "poses", how, 0)]


def case_figures(
    case: Case, scores: Sequence[FlightScore], refused: Sequence[str] = ()
) -> list[Figure]:
    """Return the figures of a case from the scores of its flights, or from refusals."""
    flights = f"{len(scores)} flights"
    if refused:
        flights += f", {len(refused)} refused ({refused[0]})"
    how = f"{case.how}; {flights}; {case.alignment} alignment"
    name = f"motion, {case.name}"
    median, p95, coverage = (4.0, 15.0, 99.0) if case.is_precise else (None, None, None)
    declared = {
        "median": Figure(f"{name}: median", None, "mm", how, median),
        "p95": Figure(f"{name}: p95", None, "mm", how, p95),
        "far": Figure(f"{name}: over 50 mm", None, "%", how, 0.0),
        "beyond": Figure(f"{name}: beyond 5 sigma", None, "%", how, 0.01),
        "nees": Figure(f"{name}: NEES, factor from 1", None, "ratio", how, 2.0),
        "coverage": Figure(f"{name}: coverage", None, "%", how, coverage, "higher"),
    }
    if not scores:
        return [figure.missing(refused[0]) for figure in declared.values()]
    score = FlightScore.concatenate(scores)
    found = summarize(score)
    distance_m = {"rigid": score.rigid_m, "similarity": score.similarity_m, "no": score.raw_m}[
        case.alignment
    ]
    is_beyond = exceeds_sigmas(score.raw_nees if case.alignment == "no" else score.aligned_nees)
    nees = found[f"{case.nees} NEES"]
    values: dict[str, float | None] = {
        "median": 1e3 * float(np.median(distance_m)),
        "p95": 1e3 * float(np.quantile(distance_m, 0.95)),
        "far": 100 * float(np.mean(distance_m > FAR_M)),
        "beyond": 100 * float(np.mean(is_beyond)),
        "nees": max(nees, 1 / nees) if np.isfinite(nees) else None,
        # A refused flight has no poses.
        "coverage": 100 * found["coverage"] * len(scores) / (len(scores) + len(refused)),
    }
    return [replace(declared[key], value=value) for key, value in values.items()]


def _score(options: Options, seed: int, case: Case) -> FlightScore:
    """Simulate a flight, solve it and score its poses."""
    if isinstance(options, SimulationOptions):
        return _score_simulated(replace(options, seed=seed))
    flight = make_flight(seed, **{"duration_s": FLIGHT_S, **options})
    solution = solve(flight.sweeps, flight.scene, receivers=flight.receivers, imu=[flight.imu])
    with_scale = case.alignment == "similarity"
    (trajectory,) = solution.trajectories
    return score_flight(flight, trajectory, solution.artifact, with_scale=with_scale)


def _score_simulated(options: SimulationOptions) -> FlightScore:
    """Score the poses of the first robot of the simulator of locatk, if their truth is known."""
    simulated = simulate(options)
    (device,) = simulated.sweeps.devices
    receivers = {} if options.receiver is None else {device: options.receiver}
    solution = solve(simulated.sweeps, simulated.scene, receivers=receivers)
    (truth,), (estimate,) = simulated.truth, solution.trajectories
    nearest = np.clip(np.searchsorted(truth.time_ns, estimate.time_ns), 0, len(truth) - 1)
    is_known = np.abs(truth.time_ns[nearest] - estimate.time_ns) < MAX_TRUTH_GAP_NS
    flying_ns = (int(truth.time_ns[0]), int(truth.time_ns[-1]))
    return score_trajectory(estimate.select(is_known), interpolate_truth(truth), flying_ns)


def interpolate_truth(truth: Trajectory) -> TruePoses:
    """Return the true poses at any time, from samples of the truth."""
    start_ns = truth.time_ns[0]
    position = make_interp_spline((truth.time_ns - start_ns) * 1e-9, truth.position, k=1)
    rotation = Slerp((truth.time_ns - start_ns) * 1e-9, Rotation.from_quat(truth.quaternion))

    def poses(time_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], Rotation]:
        time_s = np.clip((time_ns - start_ns) * 1e-9, 0.0, (truth.time_ns[-1] - start_ns) * 1e-9)
        return position(time_s), rotation(time_s)

    return poses
