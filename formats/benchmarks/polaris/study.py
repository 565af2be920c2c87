"""The figures of Polaris on simulated passes, of which everything is known.

Discs are cylinders (magpylib), never the solver's dipoles; the axes of a sensor are
converted one after the other, and samples are counts of an MLX90393 with 0.5 uT of noise,
an offset for each axis of each sensor, and the Earth's field. A pass is over one random id,
and the bar's middle passes within a centimetre of the tag's. The way of the array is not
told to the solver where a row does not say "known speed".

Found and true magnets are compared in the array's frame at the time of the detection.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.timing import SEED

Array = NDArray[np.float64]
Random = np.random.Generator

HEADINGS_DEG = range(0, 360, 15)
REPEATS = 3
"""Passes at each heading, behind the ratio to the bound; one where the speed is unknown."""

CASES = 100
"""Random designs of tags."""

PASSES = 20
"""Over the mini tag, and with each fault."""

LATERAL_M = 0.010

BEYOND_M = 0.005
"""How far a tag of random design may reach beyond the bar's ends, in sum: half a clearance."""

DEFAULT_BOUND = {"x": 0.0068, "y": 0.0072, "angle": 0.056}
"""Cramer-Rao bound of the default tag [mm, degrees]: heading 0, known speed, unknown height and
moments, dipole model."""

PROMISED = {"x": 0.007, "y": 0.007, "angle": 0.056}
WITHIN = 1.15

MINI = "paper, its miniature car"


# ---- one pass

Verdict = Literal["right", "wrong", "misplaced", "refused", "silent"]

POSE = ("x_m", "y_m", "heading_rad")

OFF, SIGMAS = np.array([1e-3, 1e-3, math.radians(1.0)]), 5.0
"""A pose is misplaced where it is off by more than this and by so many of its own standard
deviations."""


@dataclass(frozen=True)
class Outcome:
    """What became of one pass.

    Attributes
    ----------
    verdict : str
        ``"right"``: read as what it is, and as nothing else; ``"wrong"``: any other id was
        read; ``"misplaced"``: the right one, but its pose is further off than it may be;
        ``"refused"``: found, and the reason given; ``"silent"``: nothing said.
    reasons : tuple of str
        Of what was refused.
    missed : int
        True magnets at whose place none was found, read or not.
    magnets : (M, 3) ndarray
        Errors of x, y in m and of the direction in rad; ``nan`` unless right.
    pose : (3,) ndarray
        The same of the tag, where its id was read.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    missed: int
    magnets: Array
    pose: Array


def drive(tags: Tags, tag_id: int, *, known_speed: bool = False, **options: Any) -> Outcome:
    """Simulate a pass over one tag, solve it, and compare."""
    made = simulate(tags, SimulationOptions(route=(tag_id,), **options))
    speed = options.get("speed_mps", SimulationOptions.speed_mps) if known_speed else None
    return judged(made, solve([made.samples], tags, SolveOptions(speed_mps=speed)).detections)


def judged(made: SimulatedSession, detections: Sequence[TagDetection]) -> Outcome:
    """Compare the detections of a pass over one tag with the truth."""
    tag_id = made.magnets.tag_id[0]
    count = len(made.magnets)
    magnets, pose, sigma = np.full((count, 3), np.nan), np.full(3, np.nan), np.zeros(3)
    near = made.tags.spacing_m / 2
    seen = np.zeros(count, bool)
    for found in detections:
        true, lies = _true(made, found.time_s)
        each = np.array([[m.x_m, m.y_m, m.angle_rad] for m in found.magnets])
        each = each.reshape(-1, 3)
        apart = np.linalg.norm(true[:, None, :2] - each[None, :, :2], axis=2)
        seen |= apart.min(axis=1, initial=np.inf) < near
        if found.tag_id == tag_id:
            magnets = each[apart.argmin(axis=1)] - true
            pose = np.array([getattr(found, name) for name in POSE]) - lies
            sigma = np.array([getattr(found, f"sigma_{name}") for name in POSE])
    for errors in (magnets, pose):
        errors[..., 2] = np.angle(np.exp(1j * errors[..., 2]))
    reasons = tuple(found.refused for found in detections if found.refused)
    read = {found.tag_id for found in detections} - {None}
    verdict: Verdict
    if read - {tag_id}:
        verdict = "wrong"
    elif read:
        off = (np.abs(pose) > OFF) & (np.abs(pose) > SIGMAS * sigma)
        verdict = "misplaced" if off.any() else "right"
    else:
        verdict = "refused" if reasons else "silent"
    return Outcome(verdict, reasons, int(count - seen.sum()), magnets, pose)


def _true(made: SimulatedSession, time_s: float) -> tuple[Array, Array]:
    """Magnets (M, 3) and tag (3,) as x, y, direction in the array's frame at ``time_s``.

    With one tag, the frame of the truth is the tag's.
    """
    time_ns = made.truth.time_ns
    at = int(np.argmin(np.abs(time_ns - round(time_s * 1e9))))
    heading = float(heading_from_quaternion(made.truth.quaternion[at : at + 1])[0])
    cos, sin = math.cos(heading), math.sin(heading)
    points = np.vstack([made.magnets.position_m, np.zeros(2)]) - made.truth.position[at, :2]
    turned = points @ np.array([[cos, -sin], [sin, cos]])
    angle = np.r_[made.magnets.angle_rad, 0.0] - heading
    every = np.column_stack([turned, angle])
    return every[:-1], every[-1]


def random_id(tags: Tags, rng: Random) -> int:
    """Any id of the design."""
    return int.from_bytes(rng.bytes(16), "little") % capacity(tags)


def rms(errors: Array) -> Array:
    """Over all but the last axis."""
    return np.asarray(np.sqrt(np.mean(errors.reshape(-1, errors.shape[-1]) ** 2, axis=0)))


def _of(outcomes: Sequence[Outcome]) -> tuple[Array, Array]:
    """Errors of the magnets (m, 3) and of the poses (p, 3) where the tag was read right; one
    row of ``nan`` where none was."""
    right = [outcome for outcome in outcomes if outcome.verdict == "right"]
    if not right:
        return np.full((1, 3), np.nan), np.full((1, 3), np.nan)
    return np.vstack([o.magnets for o in right]), np.array([o.pose for o in right])


def _share(outcomes: Sequence[Outcome]) -> float:
    return 100 * sum(o.verdict == "right" for o in outcomes) / len(outcomes)


def _said(outcomes: Sequence[Outcome]) -> str:
    """Verdicts and reasons in words."""
    verdicts = Counter(o.verdict for o in outcomes)
    reasons = Counter(reason for o in outcomes if o.verdict == "refused" for reason in o.reasons)
    words = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())
    return words + "".join(f"; {count} {reason}" for reason, count in reasons.most_common())


# ---- all of them


def study_figures() -> list[Figure]:
    """All figures of simulated passes."""
    return [*default_figures(), *random_figures(), *mini_figures(), *fault_figures()]


def default_figures() -> Iterator[Figure]:
    """The paper's default against the bound, by headings."""
    for known in (True, False):
        passes = _by_heading(known)
        outcomes = [outcome for outcome, _, _ in passes]
        label = "default, known speed" if known else "default, unknown speed"
        n = len(outcomes)
        yield Figure(f"{label}: every bit right", _share(outcomes), "%",
                     f"{n} passes, headings 0 to 345 deg by 15, random ids: {_said(outcomes)}",
                     100.0, "higher")  # fmt: skip
        magnets, poses = _of(outcomes)
        found, tag = rms(magnets) * _UNITS, rms(poses) * _UNITS
        bound = np.sqrt(np.mean(np.vstack([m for _, m, _ in passes]), axis=0)) * _UNITS
        pose_bound = np.sqrt(np.mean([p for _, _, p in passes], axis=0)) * _UNITS
        which = "unknown height and strengths" if known else "steps free by 1 mm, no ruler"
        peer = f"Cramer-Rao bound, {which}"
        for k, axis in enumerate(DEFAULT_BOUND):
            unit = "deg" if axis == "angle" else "mm"
            how = f"rms of a magnet, {len(magnets)} of them"
            if known:
                how += f"; the default tag has a bound of {DEFAULT_BOUND[axis]}"
                yield Figure(f"{label}: {axis}", found[k], unit, how, WITHIN * PROMISED[axis],
                             peer=peer, peer_value=bound[k])  # fmt: skip
                yield Figure(f"{label}: {axis} over the bound", found[k] / bound[k], "ratio",
                             "of the two rms figures", WITHIN)  # fmt: skip
            else:
                yield Figure(f"{label}: {axis}", found[k], unit, how, peer=peer,
                             peer_value=bound[k])  # fmt: skip
        for k, axis in enumerate(("x", "y", "heading")):
            yield Figure(f"{label}: tag's {axis}", tag[k], "mm" if k < 2 else "deg",
                         f"rms of the tag's pose, {len(poses)} passes", peer=peer,
                         peer_value=pose_bound[k])  # fmt: skip


_UNITS = np.array([1e3, 1e3, 180 / math.pi])


def _by_heading(known_speed: bool) -> list[tuple[Outcome, Array, Array]]:
    """Passes with the bound's variances of their magnets (M, 3) and of their pose (3,)."""
    tags, options = Tags(), SimulationOptions()
    step = options.speed_mps / options.rate_hz
    found = []
    for repeat in range(REPEATS if known_speed else 1):
        for heading_deg in HEADINGS_DEG:
            seed = SEED + 1000 * known_speed + 400 * repeat + heading_deg
            rng = np.random.default_rng(seed)
            tag_id, heading = random_id(tags, rng), math.radians(heading_deg)
            lateral = rng.uniform(-LATERAL_M, LATERAL_M)
            outcome = drive(
                tags, tag_id, known_speed=known_speed, heading_rad=heading,
                lateral_m=lateral, seed=seed,
            )  # fmt: skip
            # The tag lies to the right of an array that passes to its left.
            covariance = magnet_covariance(
                tags, layout_of(tags, tag_id), options.array, step_m=step, heading_rad=-heading,
                offset_m=-lateral, nuisance="strength" if known_speed else "steps",
            )  # fmt: skip
            pose = pose_covariance(tags, layout_of(tags, tag_id), covariance, -heading)
            found.append((outcome, np.diag(covariance).reshape(-1, 3), np.diag(pose)))
    return found


def random_design(rng: Random) -> tuple[Tags, float]:
    """A tag of the issue's range, and a heading at which it passes under the bar."""
    order = int(rng.integers(3, 6))
    tags = Tags(
        order=order,
        magnets=int(rng.integers(4, min(13, order**2 - 1) + 1)),
        orientations=int(rng.choice([8, 16, 20])),
        spacing_m=round(rng.uniform(0.016, 0.040), 3),
    )
    heading = rng.uniform(0, math.tau, 1000)
    width = (order - 1) * tags.spacing_m * (np.abs(np.cos(heading)) + np.abs(np.sin(heading)))
    bar = float(np.ptp(SimulationOptions().array.position_m[:, 1]))
    return tags, float(heading[width < bar + BEYOND_M][0])


def random_figures() -> list[Figure]:
    """Tags of random design, at headings at which they pass under the bar."""
    outcomes, failed = [], []
    for seed in range(SEED + 3000, SEED + 3000 + CASES):
        rng = np.random.default_rng(seed)
        tags, heading = random_design(rng)
        outcome = drive(tags, random_id(tags, rng), heading_rad=heading, seed=seed)
        outcomes.append(outcome)
        if outcome.verdict != "right" or outcome.missed:
            failed.append(seed)
    how = (
        f"{CASES} passes, K 3..5, M 4..13, P 8/16/20, spacing 16..40 mm, clearance 10 mm, any "
        f"heading at which the tag fits under the bar: {_said(outcomes)}"
    )
    seeds = f"seeds that failed: {', '.join(map(str, failed)) or 'none'}"
    magnets, poses = _of(outcomes)
    wrong, misplaced = (
        sum(o.verdict == verdict for o in outcomes) for verdict in ("wrong", "misplaced")
    )
    return [
        Figure("random designs: every bit right", _share(outcomes), "%", how, 100.0, "higher"),
        Figure("random designs: magnets missed", sum(o.missed for o in outcomes), "magnets",
               f"{seeds}", 0.0),
        Figure("random designs: wrong ids", wrong, "passes", "the same", 0.0),
        Figure("random designs: misplaced", misplaced, "passes",
               "right ids, off by more than 1 mm or 1 deg and by 5 of the sigmas told", 0.0),
        Figure("random designs: place across the track", rms(magnets)[1] * 1e3, "mm",
               "rms of a magnet"),
        Figure("random designs: direction", math.degrees(rms(magnets)[2]), "deg",
               "rms of a magnet"),
        Figure("random designs: tag's place", 1e3 * math.hypot(*rms(poses)[:2]), "mm",
               "rms of the tag's pose, both axes"),
    ]  # fmt: skip


def mini_figures() -> Iterator[Figure]:
    """The miniature car's tag of 16 mm under three sensors, driven straight and anyhow."""
    car = CARS["mini"]
    array = usual_bar(car.sensors, car.spacing_m, car.rate_hz)
    for name, known, turn in (
        ("mini tag, known speed", True, 5.0),
        ("mini tag, unknown speed", False, 5.0),
        ("mini tag, any heading", False, 45.0),
    ):
        outcomes = []
        for seed in range(SEED + 5000, SEED + 5000 + PASSES):
            rng = np.random.default_rng(seed)
            heading = 90.0 * rng.integers(4) + rng.uniform(-turn, turn)
            outcomes.append(
                drive(
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
        magnets, poses = _of(outcomes)
        how = f"{PASSES} passes, four sides, turned by up to {turn:.0f} deg"
        yield Figure(f"{name}: every bit right", _share(outcomes), "%",
                     f"{how}: {_said(outcomes)}", 100.0, "higher",
                     "paper, one less its bit error rate", 96.7)  # fmt: skip
        yield Figure(f"{name}: position", 1e3 * math.hypot(*rms(magnets)[:2]), "mm",
                     "rms distance of a magnet, of those that were read", 0.58,
                     peer=MINI, peer_value=0.58)  # fmt: skip
        yield Figure(f"{name}: heading", math.degrees(rms(poses)[2]), "deg",
                     "rms, of those that were read", 1.0, peer=MINI, peer_value=0.997)  # fmt: skip


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
"""What is wrong, and how it is simulated; drift is a random walk of each axis of each sensor."""


def fault_figures() -> Iterator[Figure]:
    """The default tag at any heading, with one thing wrong and with all of them."""
    tags = Tags()
    for number, (name, faults) in enumerate(FAULTS.items()):
        outcomes = []
        for seed in range(SEED + 7000 + 100 * number, SEED + 7000 + 100 * number + PASSES):
            rng = np.random.default_rng(seed)
            options = {
                "heading_rad": rng.uniform(0, math.tau),
                "lateral_m": rng.uniform(-LATERAL_M, LATERAL_M),
                **faults,
            }
            tag_id = random_id(tags, rng)
            if "dead" in faults:
                options["dead"] = (int(rng.integers(len(SimulationOptions().array))),)
            outcomes.append(drive(tags, tag_id, seed=seed, **options))
        failed = [SEED + 7000 + 100 * number + k for k, o in enumerate(outcomes)
                  if o.verdict in ("wrong", "misplaced", "silent")]  # fmt: skip
        yield Figure(f"{name}: wrong, or nothing said", len(failed), "passes",
                     f"of {PASSES}, each at a random heading" +
                     (f"; seeds {', '.join(map(str, failed))}" if failed else ""), 0.0)  # fmt: skip
        yield Figure(f"{name}: read", _share(outcomes), "%", _said(outcomes), better="higher")
