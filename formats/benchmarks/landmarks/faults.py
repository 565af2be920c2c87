"""Figures of drives with one fault: slips, faulty landmarks, and robots that are carried.

A robot drives from landmark to landmark on the map of 24 x 24, as in :mod:`.sessions`. Slips are
jumps of the recorded odometry at any moment of the middle of the drive. A robot is carried by
joining two drives over the same floor; its wheels do not rotate in between. The solver knows
nothing of the fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.detection.trace import compose, relative
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.map.floor import AsBuiltLandmark, Cell, FloorMap
from locatk.core.landmarks.preprocessing import planar_poses
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.session import SimulatedSession, simulate
from locatk.core.landmarks.solver import solve
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.landmarks.global_localization import standard_floor
from locatk.formats.benchmarks.landmarks.sessions import score_session
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]

FAULTY_SESSIONS = 10
"""Drives with each fault."""

LEG_CELLS = (3, 4, 3)
"""Lengths of the three straight lines of a drive, at right angles."""

SAMPLE_RATE_HZ = 60.0

MIDDLE_OF_DRIVE = (0.4, 0.6)
"""Fractions of the path between which a slip occurs: five landmarks follow."""

MAX_LOST_VISITS = 3
"""Landmarks without a cell after which the robot is localized again."""

CARRIED_NS = 2_000_000_000
"""Time for which a robot is carried."""


@dataclass(frozen=True)
class FaultyDrive:
    """Simulated drive with a fault, and the warning that names it ("" for none)."""

    session: SimulatedSession
    cause: str


Fault = Callable[[FloorMap, int], FaultyDrive]


def fault_figures(folder: Path) -> Iterator[Figure]:
    """Score drives with one fault; ``folder`` contains the published maps."""
    floor, source = standard_floor(folder)
    for number, (name, fault) in enumerate(FAULTS.items()):
        first = FIRST_SEED + 1200 + 100 * number
        failures, errors_m = [], []
        for seed in range(first, first + FAULTY_SESSIONS):
            drive = fault(floor, seed)
            solution = solve(drive.session.samples, floor, odometry=drive.session.odometry)
            failure = find_failure(drive, solution)
            if failure:
                failures.append(f"{seed}: {failure}")
            errors_m.append(score_session(drive.session, solution).error_m)
        median = 1e3 * float(np.median(np.concatenate(errors_m)))
        right = 100 * (1 - len(failures) / FAULTY_SESSIONS)
        yield Figure(f"drive with {name}: solved, and cause named", right, "%",
                     f"of {FAULTY_SESSIONS} drives over 11 landmarks, {source}; at most "
                     f"{MAX_LOST_VISITS} landmarks without a cell, none in a wrong one; median "
                     f"error {median:.2f} mm; {', '.join(failures) or 'no failures'}",
                     better="higher")  # fmt: skip


def find_failure(drive: FaultyDrive, solution: Solution) -> str:
    """Return why a solution of a drive is not right, or "" if it is."""
    if not solution.trajectories:
        return "no poses"
    score = score_session(drive.session, solution)
    if score.wrong_cells:
        return f"{score.wrong_cells} wrong cells"
    lost = sum(detection.cell is None for detection in solution.detections)
    if lost > MAX_LOST_VISITS:
        return f"{lost} landmarks without a cell"
    named = {warning.code for warning in solution.warnings}
    named |= {detection.refused for detection in solution.detections}
    causes = {"wheel_slip", "landmark_displaced", "robot_carried", "misread"} & named
    if causes != {drive.cause}:
        return f"named {', '.join(sorted(causes)) or 'nothing'}"
    return ""


# ---- drives


def random_cells(floor: FloorMap, seed: int) -> tuple[Cell, ...]:
    """Return the corners of a drive at right angles, inside of the map."""
    rng = np.random.default_rng([seed, 1])
    margin = sum(LEG_CELLS) + 1
    row, column = (int(rng.integers(margin, size - margin)) for size in floor.shape)
    axis, cells = int(rng.integers(2)), [(row, column)]
    for length in LEG_CELLS:
        step = length * int(rng.choice([-1, 1]))
        row, column = (row + step, column) if axis else (row, column + step)
        cells.append((row, column))
        axis = 1 - axis
    return tuple(cells)


def drive_over(
    floor: FloorMap, seed: int, cells: tuple[Cell, ...], known: FloorMap | None = None
) -> SimulatedSession:
    """Simulate a drive; ``known`` is the map that the solver gets."""
    corners = np.array([floor.position(cell) for cell in cells])
    # A drive starts and ends between two landmarks, where a robot is put down or lifted.
    for end, next_corner in ((0, 1), (-1, -2)):
        direction = np.sign(np.round(corners[end] - corners[next_corner], 6))
        corners[end] += direction * floor.pitch_m / 2
    options = SimulationOptions(
        strategy="path",
        waypoints=tuple((float(x), float(y)) for x, y in corners),
        rate_hz=SAMPLE_RATE_HZ,
        seed=seed,
        floor_seed=seed,
    )
    return replace(simulate(floor, options), floor=known or floor)


def slip(distance_m: float, rotation_rad: float) -> Fault:
    """Return a fault: odometry jumps by a distance in any direction, and by an angle."""

    def inject(floor: FloorMap, seed: int) -> FaultyDrive:
        rng = np.random.default_rng([seed, 2])
        session = drive_over(floor, seed, random_cells(floor, seed))
        odometry = session.odometry[0]
        pose = planar_poses(odometry)
        length = np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0, prepend=pose[:1, :2]).T))
        first = int(np.searchsorted(length, length[-1] * rng.uniform(*MIDDLE_OF_DRIVE)))
        direction = rng.uniform(0, math.tau)
        shift = distance_m * np.array([math.cos(direction), math.sin(direction)])
        jumped = compose(pose[first], np.array([*shift, rotation_rad * rng.choice([-1, 1])]))
        pose[first:] = compose(jumped, relative(pose[first:], pose[first]))
        session = replace(session, odometry=(_with_poses(odometry, pose),))
        return FaultyDrive(session, "wheel_slip")

    return inject


def displace(distance_m: float, rotation_rad: float) -> Fault:
    """Return a fault: a landmark of the second line is displaced and rotated."""

    def inject(floor: FloorMap, seed: int) -> FaultyDrive:
        rng = np.random.default_rng([seed, 3])
        cells = random_cells(floor, seed)
        direction = rng.uniform(0, math.tau)
        built = AsBuiltLandmark(
            distance_m * math.cos(direction),
            distance_m * math.sin(direction),
            rotation_rad * float(rng.choice([-1, 1])),
            np.full(4, np.nan),
            np.full(7, np.nan),
        )
        faulty = replace(floor, built={_cell_between(cells[1], cells[2], 2): built})
        return FaultyDrive(drive_over(faulty, seed, cells, floor), "landmark_displaced")

    return inject


def exchange(floor: FloorMap, seed: int) -> FaultyDrive:
    """Exchange two landmarks of the second line that differ."""
    cells = random_cells(floor, seed)
    on_line = [_cell_between(cells[1], cells[2], k) for k in range(LEG_CELLS[1] + 1)]
    codes = floor.codes.copy()
    first, second = next(
        (one, other)
        for one in on_line[1:]
        for other in on_line[1:]
        if floor.codes[one] != floor.codes[other]
    )
    codes[first], codes[second] = floor.codes[second], floor.codes[first]
    faulty = replace(floor, codes=codes)
    return FaultyDrive(drive_over(faulty, seed, cells, floor), "misread")


def carry(floor: FloorMap, seed: int) -> FaultyDrive:
    """Join two drives; the robot is carried from the end of the first to the second."""
    first = drive_over(floor, seed, random_cells(floor, seed))
    other_start = random_cells(floor, seed + 50)
    second = drive_over(floor, seed, other_start)
    samples = _join_samples(first.samples[0], second.samples[0])
    odometry = _join_odometry(first.odometry[0], second.odometry[0])
    truth = _join(first.truth[0], second.truth[0])
    session = replace(first, samples=(samples,), odometry=(odometry,), truth=(truth,))
    return FaultyDrive(session, "robot_carried")


def _cell_between(first: Cell, last: Cell, steps: int) -> Cell:
    row, column = (a + steps * int(np.sign(b - a)) for a, b in zip(first, last, strict=True))
    return row, column


def _with_poses(trajectory: Trajectory, pose: Array) -> Trajectory:
    position = np.column_stack([pose[:, :2], np.zeros(len(pose))])
    return replace(trajectory, position=position, quaternion=quaternion_from_heading(pose[:, 2]))


def _later(first_ns: NDArray[np.int64], second_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([first_ns, second_ns - second_ns[0] + first_ns[-1] + CARRIED_NS])


def _join_samples(first: HallSamples, second: HallSamples) -> HallSamples:
    return replace(
        first,
        time_ns=_later(first.time_ns, second.time_ns),
        field_t=np.concatenate([first.field_t, second.field_t]),
    )


def _join_odometry(first: Trajectory, second: Trajectory) -> Trajectory:
    """Continue the first odometry by the motion of the second."""
    own, other = planar_poses(first), planar_poses(second)
    joined = _join(first, second)
    return _with_poses(joined, np.vstack([own, compose(own[-1], relative(other, other[0]))]))


def _join(first: Trajectory, second: Trajectory) -> Trajectory:
    return replace(
        first,
        time_ns=_later(first.time_ns, second.time_ns),
        position=np.concatenate([first.position, second.position]),
        quaternion=np.concatenate([first.quaternion, second.quaternion]),
        covariance=np.concatenate([first.covariance, second.covariance]),
    )


FAULTS: dict[str, Fault] = {
    "a slip of 10 deg": slip(0.0, math.radians(10)),
    "a slip of 90 deg": slip(0.0, math.radians(90)),
    "a slip of 20 mm": slip(0.02, 0.0),
    "a slip of 80 mm and 5 deg": slip(0.08, math.radians(5)),
    "a slip of 190 mm": slip(0.19, 0.0),
    "a landmark rotated by 5 deg": displace(0.0, math.radians(5)),
    "a landmark rotated by 8 deg": displace(0.0, math.radians(8)),
    "a landmark displaced by 30 mm": displace(0.03, 0.0),
    "two exchanged landmarks": exchange,
    "a carried robot": carry,
}
"""Faults by name, in the order of their seeds."""
