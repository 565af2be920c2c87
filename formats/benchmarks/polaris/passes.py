"""Figures of Polaris on simulated passes over one tag.

Discs are cylinders (magpylib), never the solver's dipoles. The axes of a sensor are converted one
after the other, and samples are counts of an MLX90393 with 0.5 uT of noise, an offset for each
axis of each sensor, and the Earth's field. The id of the tag is random, and the middle of the bar
passes within a centimetre of that of the tag. The solver does not know the path of the array,
except its speed in rows with "known speed".

Estimated and true magnets are compared in the frame of the array at the time of the detection.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion
from locatk.core.polaris.codec import capacity, layout_of
from locatk.core.polaris.design.accuracy_bound import magnet_covariance, pose_covariance
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.simulation.options import CARS, usual_bar
from locatk.core.polaris.simulation.session import SimulatedSession, SimulationOptions, simulate
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import Tags
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]
Random = np.random.Generator

HEADINGS_DEG = range(0, 360, 15)
HEADING_REPEATS = 3
"""Passes at each heading with known speed, for the ratio to the bound; one with unknown speed."""

RANDOM_DESIGNS = 100

REPEATED_PASSES = 20
"""Passes over the mini tag, and with each fault."""

MAX_LATERAL_M = 0.010

MAX_OVERHANG_M = 0.005
"""Largest length by which a tag of random design extends beyond the bar: half a clearance."""

DEFAULT_BOUND = {"x": 0.0068, "y": 0.0072, "angle": 0.056}
"""Cramer-Rao bound of the default tag [mm, degrees]: heading 0, known speed, unknown height and
moments, dipole model."""

TARGET_BOUND = {"x": 0.007, "y": 0.007, "angle": 0.056}
TARGET_BOUND_RATIO = 1.15

MINI_PEER = "paper, its miniature car"

ERROR_UNITS = np.array([1e3, 1e3, 180 / math.pi])
"""Factors from x, y [m] and direction [rad] to mm and degrees."""


# ---- one pass

Verdict = Literal["right", "wrong", "misplaced", "refused", "silent"]

POSE_FIELDS = ("x_m", "y_m", "heading_rad")

MISPLACED_ERROR, MISPLACED_SIGMAS = np.array([1e-3, 1e-3, math.radians(1.0)]), 5.0
"""Errors (x and y [m], heading [rad], and in standard deviations) beyond which a pose is
misplaced."""


@dataclass(frozen=True)
class PassOutcome:
    """Result of one pass, compared with the truth.

    Attributes
    ----------
    verdict : str
        ``"right"``: the true id was read and no other; ``"wrong"``: another id was read;
        ``"misplaced"``: the true id was read, but its pose has too large an error; ``"refused"``:
        not read, for a reason; ``"silent"``: no detection and no reason.
    reasons : tuple of str
        Reasons of the refusals.
    missed : int
        True magnets without a detected one at their position.
    magnets : (M, 3) ndarray
        Errors of x and y [m] and of the direction [rad]; ``nan`` unless the id was read.
    pose : (3,) ndarray
        Errors of the tag's x and y [m] and heading [rad]; ``nan`` unless the id was read.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    missed: int
    magnets: Array
    pose: Array


def simulate_pass(
    tags: Tags, tag_id: int, *, known_speed: bool = False, **options: Any
) -> PassOutcome:
    """Simulate a pass over one tag, solve it, and compare the result with the truth."""
    session = simulate(tags, SimulationOptions(route=(tag_id,), **options))
    speed = options.get("speed_mps", SimulationOptions.speed_mps) if known_speed else None
    solution = solve([session.samples], tags, SolveOptions(speed_mps=speed))
    outcome = score_pass(session, solution.detections)
    if outcome.verdict == "silent" and "no_magnets" in solution.rejected:
        # Counted and reported, without a detection.
        outcome = replace(outcome, verdict="refused", reasons=("no_magnets",))
    return outcome


def score_pass(session: SimulatedSession, detections: Sequence[TagDetection]) -> PassOutcome:
    """Compare the detections of a pass over one tag with the truth."""
    tag_id = session.magnets.tag_id[0]
    count = len(session.magnets)
    magnets, pose, sigma = np.full((count, 3), np.nan), np.full(3, np.nan), np.zeros(3)
    is_detected = np.zeros(count, bool)
    for detection in detections:
        true_magnets, true_pose = _true_geometry(session, detection.time_s)
        estimates = np.array([[m.x_m, m.y_m, m.angle_rad] for m in detection.magnets])
        estimates = estimates.reshape(-1, 3)
        distances = np.linalg.norm(true_magnets[:, None, :2] - estimates[None, :, :2], axis=2)
        is_detected |= distances.min(axis=1, initial=np.inf) < session.tags.spacing_m / 2
        if detection.tag_id == tag_id:
            magnets = estimates[distances.argmin(axis=1)] - true_magnets
            pose = np.array([getattr(detection, name) for name in POSE_FIELDS]) - true_pose
            sigma = np.array([getattr(detection, f"sigma_{name}") for name in POSE_FIELDS])
    for errors in (magnets, pose):
        errors[..., 2] = np.angle(np.exp(1j * errors[..., 2]))
    reasons = tuple(detection.refused for detection in detections if detection.refused)
    read_ids = {detection.tag_id for detection in detections} - {None}
    verdict: Verdict
    if read_ids - {tag_id}:
        verdict = "wrong"
    elif read_ids:
        is_off = (np.abs(pose) > MISPLACED_ERROR) & (np.abs(pose) > MISPLACED_SIGMAS * sigma)
        verdict = "misplaced" if is_off.any() else "right"
    else:
        verdict = "refused" if reasons else "silent"
    return PassOutcome(verdict, reasons, int(count - is_detected.sum()), magnets, pose)


def _true_geometry(session: SimulatedSession, time_s: float) -> tuple[Array, Array]:
    """Return the magnets (M, 3) and the tag (3,) as x, y, direction in the array's frame.

    With one tag, the frame of the truth is that of the tag.
    """
    index = int(np.argmin(np.abs(session.truth.time_ns - round(time_s * 1e9))))
    heading = float(heading_from_quaternion(session.truth.quaternion[index : index + 1])[0])
    cos, sin = math.cos(heading), math.sin(heading)
    points = np.vstack([session.magnets.position_m, np.zeros(2)])
    points = (points - session.truth.position[index, :2]) @ np.array([[cos, -sin], [sin, cos]])
    angles = np.r_[session.magnets.angle_rad, 0.0] - heading
    geometry = np.column_stack([points, angles])
    return geometry[:-1], geometry[-1]


def random_id(tags: Tags, rng: Random) -> int:
    """Return a random id of the design."""
    return int.from_bytes(rng.bytes(16), "little") % capacity(tags)


def rms(errors: Array) -> Array:
    """Return the root mean square over all axes but the last one."""
    return np.asarray(np.sqrt(np.mean(errors.reshape(-1, errors.shape[-1]) ** 2, axis=0)))


def _errors(outcomes: Sequence[PassOutcome]) -> tuple[Array, Array]:
    """Return the errors of magnets (m, 3) and poses (p, 3) of tags that were read correctly.

    One row of ``nan`` if there are none.
    """
    correct = [outcome for outcome in outcomes if outcome.verdict == "right"]
    if not correct:
        return np.full((1, 3), np.nan), np.full((1, 3), np.nan)
    return np.vstack([o.magnets for o in correct]), np.array([o.pose for o in correct])


def correct_percent(outcomes: Sequence[PassOutcome]) -> float:
    """Return the percentage of tags that were read correctly."""
    return 100 * sum(outcome.verdict == "right" for outcome in outcomes) / len(outcomes)


def describe_outcomes(outcomes: Sequence[PassOutcome]) -> str:
    """Return the numbers of verdicts and reasons as text."""
    verdicts = Counter(o.verdict for o in outcomes)
    reasons = Counter(reason for o in outcomes if o.verdict == "refused" for reason in o.reasons)
    text = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())
    return text + "".join(f"; {count} {reason}" for reason, count in reasons.most_common())


# ---- designs


def pass_figures() -> list[Figure]:
    """Return all figures of simulated passes."""
    return [*default_figures(), *random_figures(), *mini_figures(), *fault_figures()]


def default_figures() -> Iterator[Figure]:
    """Compare the paper's default tag at all headings with the Cramer-Rao bound."""
    for known in (True, False):
        passes = _passes_by_heading(known)
        outcomes = [outcome for outcome, _, _ in passes]
        label = "default, known speed" if known else "default, unknown speed"
        yield Figure(f"{label}: every bit right", correct_percent(outcomes), "%",
                     f"{len(outcomes)} passes, headings 0 to 345 deg by 15, random ids: "
                     f"{describe_outcomes(outcomes)}", 100.0, "higher")  # fmt: skip
        magnets, poses = _errors(outcomes)
        magnet_rms, pose_rms = rms(magnets) * ERROR_UNITS, rms(poses) * ERROR_UNITS
        bound = np.sqrt(np.mean(np.vstack([m for _, m, _ in passes]), axis=0)) * ERROR_UNITS
        pose_bound = np.sqrt(np.mean([p for _, _, p in passes], axis=0)) * ERROR_UNITS
        unknowns = "unknown height and strengths" if known else "steps free by 1 mm, no ruler"
        peer = f"Cramer-Rao bound, {unknowns}"
        for k, axis in enumerate(DEFAULT_BOUND):
            unit = "deg" if axis == "angle" else "mm"
            how = f"rms of a magnet, {len(magnets)} of them"
            if known:
                how += f"; the default tag has a bound of {DEFAULT_BOUND[axis]}"
                yield Figure(f"{label}: {axis}", magnet_rms[k], unit, how,
                             TARGET_BOUND_RATIO * TARGET_BOUND[axis], peer=peer,
                             peer_value=bound[k])  # fmt: skip
                yield Figure(f"{label}: {axis} over the bound", magnet_rms[k] / bound[k], "ratio",
                             "of the two rms figures", TARGET_BOUND_RATIO)  # fmt: skip
            else:
                yield Figure(f"{label}: {axis}", magnet_rms[k], unit, how, peer=peer,
                             peer_value=bound[k])  # fmt: skip
        for k, axis in enumerate(("x", "y", "heading")):
            yield Figure(f"{label}: tag's {axis}", pose_rms[k], "mm" if k < 2 else "deg",
                         f"rms of the tag's pose, {len(poses)} passes", peer=peer,
                         peer_value=pose_bound[k])  # fmt: skip


def _passes_by_heading(known_speed: bool) -> list[tuple[PassOutcome, Array, Array]]:
    """Simulate passes; return them with bounds of the variances of magnets (M, 3) and pose (3,)."""
    tags, options = Tags(), SimulationOptions()
    step = options.speed_mps / options.rate_hz
    passes = []
    for repeat in range(HEADING_REPEATS if known_speed else 1):
        for heading_deg in HEADINGS_DEG:
            seed = FIRST_SEED + 1000 * known_speed + 400 * repeat + heading_deg
            rng = np.random.default_rng(seed)
            tag_id, heading = random_id(tags, rng), math.radians(heading_deg)
            lateral = rng.uniform(-MAX_LATERAL_M, MAX_LATERAL_M)
            outcome = simulate_pass(
                tags, tag_id, known_speed=known_speed, heading_rad=heading,
                lateral_m=lateral, seed=seed,
            )  # fmt: skip
            # The tag is to the right of an array that passes to its left.
            covariance = magnet_covariance(
                tags, layout_of(tags, tag_id), options.array, step_m=step, heading_rad=-heading,
                offset_m=-lateral, nuisance="strength" if known_speed else "steps",
            )  # fmt: skip
            pose = pose_covariance(tags, layout_of(tags, tag_id), covariance, -heading)
            passes.append((outcome, np.diag(covariance).reshape(-1, 3), np.diag(pose)))
    return passes


def random_design(rng: Random) -> tuple[Tags, float]:
    """Return a random tag, and a random heading at which it fits under the bar."""
    order = int(rng.integers(3, 6))
    tags = Tags(
        order=order,
        magnets=int(rng.integers(4, min(13, order**2 - 1) + 1)),
        orientations=int(rng.choice([8, 16, 20])),
        spacing_m=round(rng.uniform(0.016, 0.040), 3),
    )
    heading = rng.uniform(0, math.tau, 1000)
    width = (order - 1) * tags.spacing_m * (np.abs(np.cos(heading)) + np.abs(np.sin(heading)))
    bar_m = float(np.ptp(SimulationOptions().array.position_m[:, 1]))
    return tags, float(heading[width < bar_m + MAX_OVERHANG_M][0])


def random_figures() -> list[Figure]:
    """Pass over tags of random design, at headings at which they fit under the bar."""
    outcomes, failed = [], []
    for seed in range(FIRST_SEED + 3000, FIRST_SEED + 3000 + RANDOM_DESIGNS):
        rng = np.random.default_rng(seed)
        tags, heading = random_design(rng)
        outcome = simulate_pass(tags, random_id(tags, rng), heading_rad=heading, seed=seed)
        outcomes.append(outcome)
        if outcome.verdict != "right" or outcome.missed:
            failed.append(seed)
    how = (
        f"{RANDOM_DESIGNS} passes, K 3..5, M 4..13, P 8/16/20, spacing 16..40 mm, clearance "
        f"10 mm, any heading at which the tag fits under the bar: {describe_outcomes(outcomes)}"
    )
    seeds = f"seeds that failed: {', '.join(map(str, failed)) or 'none'}"
    magnets, poses = _errors(outcomes)
    wrong, misplaced = (
        sum(o.verdict == verdict for o in outcomes) for verdict in ("wrong", "misplaced")
    )
    return [
        Figure("random designs: every bit right", correct_percent(outcomes), "%", how, 100.0,
               "higher"),
        Figure("random designs: magnets missed", sum(o.missed for o in outcomes), "magnets",
               f"{seeds}", 0.0),
        Figure("random designs: wrong ids", wrong, "passes", "of the same passes", 0.0),
        Figure("random designs: misplaced", misplaced, "passes",
               "correct ids, with errors of more than 1 mm or 1 deg and of 5 sigmas", 0.0),
        Figure("random designs: place across the track", rms(magnets)[1] * 1e3, "mm",
               "rms of a magnet"),
        Figure("random designs: direction", math.degrees(rms(magnets)[2]), "deg",
               "rms of a magnet"),
        Figure("random designs: tag's place", 1e3 * math.hypot(*rms(poses)[:2]), "mm",
               "rms of the tag's pose, both axes"),
    ]  # fmt: skip


def mini_figures() -> Iterator[Figure]:
    """Pass over the miniature car's tag of 16 mm with three sensors, straight and at any angle."""
    car = CARS["mini"]
    array = usual_bar(car.sensors, car.spacing_m, car.rate_hz)
    for name, known, max_angle_deg in (
        ("mini tag, known speed", True, 5.0),
        ("mini tag, unknown speed", False, 5.0),
        ("mini tag, any heading", False, 45.0),
    ):
        outcomes = []
        for seed in range(FIRST_SEED + 5000, FIRST_SEED + 5000 + REPEATED_PASSES):
            rng = np.random.default_rng(seed)
            heading = 90.0 * rng.integers(4) + rng.uniform(-max_angle_deg, max_angle_deg)
            outcomes.append(
                simulate_pass(
                    car.tags,
                    random_id(car.tags, rng),
                    known_speed=known,
                    array=array,
                    rate_hz=car.rate_hz,
                    speed_mps=car.speed_mps,
                    heading_rad=math.radians(heading),
                    seed=seed,
                )
            )
        magnets, poses = _errors(outcomes)
        how = f"{REPEATED_PASSES} passes, four sides, rotated by up to {max_angle_deg:.0f} deg"
        yield Figure(f"{name}: every bit right", correct_percent(outcomes), "%",
                     f"{how}: {describe_outcomes(outcomes)}", 100.0, "higher",
                     "paper, one less its bit error rate", 96.7)  # fmt: skip
        yield Figure(f"{name}: position", 1e3 * math.hypot(*rms(magnets)[:2]), "mm",
                     "rms distance of a magnet, of those that were read", 0.58,
                     peer=MINI_PEER, peer_value=0.58)  # fmt: skip
        yield Figure(f"{name}: heading", math.degrees(rms(poses)[2]), "deg",
                     "rms, of those that were read", 1.0, peer=MINI_PEER,
                     peer_value=0.997)  # fmt: skip


# ---- faults

FAULTS: dict[str, dict[str, Any]] = {
    "offsets of 100 uT": {"offset_t": 100e-6},
    "drift of 1 uT in a second": {"drift_t": 1e-6},
    "ten bits of iron debris to 2 mm": {"debris": 10},
    "speed +-30 %": {"speed_wobble": 0.3},
    "one dead sensor": {"dead": True},
    "2 % of the frames lost": {"lost": 0.02},
    "motors' field of 9 uT at speed +-30 %": {"motor_t": 9e-6, "speed_wobble": 0.3},
    "all of these": {
        "offset_t": 100e-6, "drift_t": 1e-6, "debris": 10, "speed_wobble": 0.3, "dead": True,
        "lost": 0.02, "motor_t": 9e-6,
    },
}  # fmt: skip
"""Name of a fault, and the simulator options for it; drift is a random walk of each axis."""


def fault_figures() -> Iterator[Figure]:
    """Pass over the default tag at any heading, with one fault and with all of them."""
    tags = Tags()
    for number, (name, faults) in enumerate(FAULTS.items()):
        outcomes = []
        for seed in range(
            FIRST_SEED + 7000 + 100 * number, FIRST_SEED + 7000 + 100 * number + REPEATED_PASSES
        ):
            rng = np.random.default_rng(seed)
            options = {
                "heading_rad": rng.uniform(0, math.tau),
                "lateral_m": rng.uniform(-MAX_LATERAL_M, MAX_LATERAL_M),
                **faults,
            }
            tag_id = random_id(tags, rng)
            if "dead" in faults:
                options["dead"] = (int(rng.integers(len(SimulationOptions().array))),)
            outcomes.append(simulate_pass(tags, tag_id, seed=seed, **options))
        failed = [FIRST_SEED + 7000 + 100 * number + k for k, o in enumerate(outcomes)
                  if o.verdict in ("wrong", "misplaced", "silent")]  # fmt: skip
        yield Figure(f"{name}: wrong, or nothing said", len(failed), "passes",
                     f"of {REPEATED_PASSES}, each at a random heading" +
                     (f"; seeds {', '.join(map(str, failed))}" if failed else ""), 0.0)  # fmt: skip
        yield Figure(
            f"{name}: read",
            correct_percent(outcomes),
            "%",
            describe_outcomes(outcomes),
            better="higher",
        )
