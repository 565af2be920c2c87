"""Figures of the dots: rendered frames, each localized on its own, and the published frame.

Unless a row states otherwise, frames are like those on which cellulo-localization was measured:
188 x 120 px of 0.046 mm over a grid of 0.508 mm, anywhere on a sheet and at any rotation, with a
blur of 0.6 px, noise of 2 grey values, dots of 0.30 pitches and an ideal lens. No frame uses the
result of another ("cold"). A position is correct within half a pitch and five degrees.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.drawing import layout
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import (
    LocalizedFrames,
    localize_frames,
    unlocalized_frames,
)
from locatk.core.dots.sheet import Manifest
from locatk.core.dots.simulation import session as simulate
from locatk.core.dots.simulation.decoys import KINDS, decoys
from locatk.core.dots.simulation.paths import CameraPath
from locatk.core.dots.solver import METHODS, SolveOptions, solve
from locatk.core.geometry import heading_from_quaternion
from locatk.core.paper_sizes import paper_size
from locatk.formats import images as image_files
from locatk.formats.benchmarks.dots.disturbances import disturbance_figures
from locatk.formats.benchmarks.dots.printing import codec_figures, default_sheet, print_figures
from locatk.formats.benchmarks.figures import Duration, Figure, measure_or_explain
from locatk.formats.benchmarks.timing import (
    FIRST_SEED,
    measure_single_threaded,
    time_call,
    time_each,
)

Array = NDArray[np.float64]

CONDITION_FRAMES = 1000
"""Frames of each condition, and of each measurement of speed."""

DECOY_FRAMES = 500
"""Frames of each kind without the pattern."""

PAPER_METHOD_FRAMES = 200
"""Frames of each condition for the published method, which decodes frame by frame."""

CELLULO = "cellulo-localization"
PAPER_LENS = simulate.camera()
IDEAL_LENS = simulate.camera(0.0)

MAX_ERROR_PITCHES, MAX_ERROR_DEG = 0.5, 5.0
"""Largest errors of a correct position."""

FRAME_BMP_CENTRE = (129.168, 3224.506)
FRAME_BMP_HEADING_DEG = 1.603
"""Centre [pitches] and heading of frame.bmp, the image a.bmp of cellulo-localization, decoded by a
prototype and confirmed by the decoder of that repository."""

STUDY_SAMPLES = 20
"""Frames at each position and angle of the study."""

STUDY_GRID, STUDY_ANGLES = 11, 36
STUDY_SPAN_M = 0.2

STUDY_JITTER_M = 10e-6
"""Standard deviation of the position of a simulated printed dot."""

STUDY_MAX_ERROR_MM, STUDY_MAX_ERROR_DEG = 0.254, 5.0
"""Largest errors that are averaged (half a pitch); frames beyond are counted as wrong, as in the
paper's Fig. 13."""

PAPER_RIGHT_PERCENT = 99.17
"""Frames of which the paper decoded x (section IV-A): 120 of 121 positions."""

TABLE_III = {"x": ("mm", 0.155, 0.010), "y": ("mm", 0.273, 0.014), "heading": ("deg", 1.581, 0.407)}
"""Unit, worst error and precision as published."""

STUDY_PEER = "paper, Table III"


@dataclass(frozen=True)
class Condition:
    """Options of rendered frames, with targets and values of a peer.

    Attributes
    ----------
    name : str
    options : dict
        Options of the simulator.
    target, peer_value : float or None
        Correct frames in percent.
    peer : str
    rms_target, rms_peer_value : float or None
        RMS error in pitches.
    camera : Camera or None
        Calibration that the solver knows.
    """

    name: str
    options: dict[str, Any] = field(default_factory=dict)
    target: float | None = None
    peer_value: float | None = None
    peer: str = f"{CELLULO}, warm"
    rms_target: float | None = None
    rms_peer_value: float | None = None
    camera: Camera | None = None


CELLULO_COLD = f"{CELLULO}, cold: 74-78"
TILT_TO_10_DEG = {"tilt_rad": math.radians(10)}

CONDITIONS = (
    Condition("dots 0.25", {"dot": 0.25}, 100.0, 78.0, CELLULO_COLD, 0.003, 0.050),
    Condition("dots 0.30", {}, 100.0, 78.0, CELLULO_COLD, 0.003, 0.050),
    Condition("dots 0.35", {"dot": 0.35}, 100.0, 78.0, CELLULO_COLD, 0.003, 0.050),
    Condition("dots 1/6", {"dot": 1 / 6}, 99.0, 0.7),
    Condition("2 % missing", {"missing": 0.02}, 99.5, 83.0),
    Condition("5 % missing", {"missing": 0.05}, 99.0, 62.0),
    Condition("10 % missing", {"missing": 0.10}, 97.0, 31.0),
    Condition("blur 2.2 px", {"blur_px": 2.2}, 99.0, 92.5),
    Condition("vignette 0.4", {"vignette": 0.4}, 100.0, 100.0),
    Condition("noise 16", {"noise": 16.0}, 100.0, 100.0),
    Condition("tilt to 10 deg", TILT_TO_10_DEG, 99.0),
    Condition("paper's lens", {"camera": PAPER_LENS}, 99.0, camera=PAPER_LENS),
    Condition("paper's lens, not calibrated", {"camera": PAPER_LENS}, 99.0),
    Condition(
        "paper's lens, tilt to 10 deg",
        {"camera": PAPER_LENS, **TILT_TO_10_DEG},
        99.0,
        camera=PAPER_LENS,
    ),
    Condition(
        "paper's lens, tilt to 10 deg, not calibrated",
        {"camera": PAPER_LENS, **TILT_TO_10_DEG},
        99.0,
    ),
    Condition("motion blur 2 px", {"motion_px": 2.0}),
    Condition("5 % dust", {"dust": 0.05}),
    Condition("printer's jitter 10 um", {"jitter_m": 10e-6}),
)


def figures(data: Path) -> list[Figure]:
    """Return all figures of dots; ``data`` is the folder of published recordings."""
    return [
        *codec_figures(),
        *print_figures(),
        *condition_figures(),
        *disturbance_figures(),
        *decoy_figures(),
        *paper_method_figures(),
        *speed_figures(),
        *published_frame_figures(data / "dots" / "frame.bmp"),
        *study_figures(),
    ]


# ---- conditions


@dataclass(frozen=True)
class FrameScore:
    """Numbers of frames by result, and the RMS error of the correct ones in pitches."""

    frames: int
    correct: int
    wrong: int
    rms: float

    @property
    def accepted(self) -> int:
        """Frames with a pose."""
        return self.correct + self.wrong

    @property
    def correct_percent(self) -> float:
        """Correct frames in percent of all."""
        return 100 * self.correct / self.frames

    @property
    def wrong_percent(self) -> float:
        """Wrong frames in percent of the accepted ones."""
        return 100 * self.wrong / max(self.accepted, 1)


def render(
    condition: Condition, n: int, seed: int, manifest: Manifest
) -> tuple[NDArray[np.uint8], Array, Array]:
    """Render frames (n, h, w); return them with true grid coordinates (n, 2) and headings (n,)."""
    options = simulate.SimulationOptions(
        frames=n, path="random", seed=seed, **{"camera": IDEAL_LENS, **condition.options}
    )
    simulated = simulate.simulate(manifest, options)
    start = manifest.to_metres(0, manifest.sheets[0].origin)
    offset = simulated.truth.position[:, :2] - start
    grid = offset @ np.linalg.inv(manifest.jacobian(0)).T + manifest.sheets[0].origin
    return (
        np.array(list(simulated.frames.images)),
        grid,
        heading_from_quaternion(simulated.truth.quaternion),
    )


def score_frames(located: LocalizedFrames, grid: Array, heading: Array) -> FrameScore:
    """Compare localized frames with true grid coordinates (n, 2) and headings (n,)."""
    accepted = located.accepted
    errors = located.grid - grid
    heading_errors = np.angle(np.exp(1j * (located.heading - heading)))
    is_correct = np.abs(errors).max(axis=1) < MAX_ERROR_PITCHES
    is_correct &= np.abs(heading_errors) < math.radians(MAX_ERROR_DEG)
    correct = accepted & is_correct
    rms = np.sqrt(np.mean(errors[correct] ** 2, axis=0)).max() if correct.any() else math.nan
    return FrameScore(
        len(grid), int(correct.sum()), int((accepted & ~is_correct).sum()), float(rms)
    )


def condition_figures() -> list[Figure]:
    """Score rendered frames under each condition."""
    manifest = default_sheet("A0")
    rows: list[Figure] = []
    accepted = wrong = 0
    for number, condition in enumerate(CONDITIONS):
        images, grid, heading = render(
            condition, CONDITION_FRAMES, FIRST_SEED + 100 + number, manifest
        )
        located = localize_frames(
            images, codec(manifest.codec), condition.camera, other_codec_odds=0
        )
        score = score_frames(located, grid, heading)
        rows += _condition_rows(condition, score)
        accepted, wrong = accepted + score.accepted, wrong + score.wrong
    percent = 100 * wrong / max(accepted, 1)
    how = f"{wrong} of {accepted}"
    return [*rows, Figure("all conditions: wrong among accepted", percent, "%", how, 0.1)]


def _condition_rows(condition: Condition, score: FrameScore) -> Iterator[Figure]:
    has_peer = condition.peer_value is not None
    peer = condition.peer if has_peer else None
    yield Figure(
        f"{condition.name}: right", score.correct_percent, "%",
        f"of {score.frames} frames, each cold", condition.target, "higher",
        peer, condition.peer_value,
    )  # fmt: skip
    yield Figure(
        f"{condition.name}: rms", score.rms, "pitch",
        "the larger of x and y, of the correct ones", condition.rms_target, "lower",
        f"{CELLULO}; 0.008 with its centre corrected" if condition.rms_peer_value else None,
        condition.rms_peer_value,
    )  # fmt: skip
    yield Figure(
        f"{condition.name}: wrong among accepted", score.wrong_percent, "%",
        f"{score.wrong} of {score.accepted}", 0.1, "lower",
        peer and "the same, says nothing", 100 - condition.peer_value if has_peer else None,  # type: ignore[operator]
    )  # fmt: skip


def decoy_figures() -> list[Figure]:
    """Count the frames without the pattern that are accepted, by kind."""
    rows, total = [], 0
    for kind in KINDS:
        images = decoys(kind, DECOY_FRAMES, FIRST_SEED + 200)
        located = localize_frames(images, codec("anoto"), other_codec_odds=0)
        accepted = int(located.accepted.sum())
        total += accepted
        rows.append(
            Figure(f"{kind}: accepted", 100 * accepted / DECOY_FRAMES, "%",
                   f"{accepted} of {DECOY_FRAMES}", 0.1, peer=CELLULO, peer_value=100.0)
        )  # fmt: skip
    count = DECOY_FRAMES * len(KINDS)
    return [
        *rows,
        Figure("all without the pattern: accepted", 100 * total / count, "%",
               f"{total} of {count}", 0.1, peer=CELLULO, peer_value=100.0),
    ]  # fmt: skip


def paper_method_figures() -> list[Figure]:
    """Score the published algorithm on frames as it was designed for."""
    manifest = default_sheet("A0")
    rows = []
    for condition in (CONDITIONS[1], CONDITIONS[6]):
        images, grid, heading = render(condition, PAPER_METHOD_FRAMES, FIRST_SEED + 300, manifest)
        score = score_frames(_solve_as_session(images, manifest, "paper"), grid, heading)
        name = f"--method paper, {condition.name}"
        rows += [
            Figure(f"{name}: right", score.correct_percent, "%",
                   f"of {score.frames} frames", None, "higher",
                   condition.peer, condition.peer_value),
            Figure(f"{name}: rms", score.rms, "pitch",
                   "the larger of x and y, of the correct ones",
                   peer=CELLULO if condition.rms_peer_value else None,
                   peer_value=condition.rms_peer_value),
            Figure(f"{name}: wrong among accepted", score.wrong_percent, "%",
                   f"{score.wrong} of {score.accepted}"),
        ]  # fmt: skip
    return rows


def _solve_as_session(
    images: NDArray[np.uint8], manifest: Manifest, method: str
) -> LocalizedFrames:
    """Solve frames as those of a session, and return the results in grid coordinates."""
    n = len(images)
    frames = Frames("camera", np.arange(n), tuple(map(str, range(n))), list(images))
    solution = solve([frames], manifest, SolveOptions(method))
    located = unlocalized_frames(n, "rejected")
    for detection in solution.detections:
        k = int(detection.frame)
        located.grid[k] = detection.grid_x, detection.grid_y
        located.heading[k] = detection.heading_rad
        located.rejected[k] = ""
    return located


# ---- speed


def speed_figures() -> list[Figure]:
    """Time the localization of frames in a batch, and of single ones."""
    batch = Figure(
        "frames a second, in a batch", None, "1/s",
        f"localize_frames() of {CONDITION_FRAMES} frames of 188 x 120 px, processor time of one "
        "thread, best of 3", 4000.0, "higher", CELLULO, 4000.0, "numpy",
    )  # fmt: skip
    single = Figure(
        "a single frame", None, "ms",
        "localize_frames() of one frame, median, processor time of one thread", 0.5, "lower",
        CELLULO, 0.26, "numpy",
    )  # fmt: skip
    frames = CONDITION_FRAMES
    return [
        measure_single_threaded(batch, f"dots.suite.time_batch({frames})", frames),
        measure_single_threaded(single, f"dots.suite.time_single({min(frames, 200)})", 1e3),
    ]


def time_batch(frames: int) -> Duration:
    """Time the localization of a batch of frames."""
    images, _, _ = render(CONDITIONS[1], frames, FIRST_SEED + 400, default_sheet("A0"))
    table = codec("anoto")
    return time_call(lambda: localize_frames(images, table, other_codec_odds=0), 3)


def time_single(frames: int) -> Duration:
    """Time the localization of single frames; the median counts."""
    images, _, _ = render(CONDITIONS[1], frames, FIRST_SEED + 401, default_sheet("A0"))
    table = codec("anoto")
    calls = [partial(localize_frames, image[None], table, other_codec_odds=0) for image in images]
    seconds, factor = time_each(calls, 3)
    return Duration(float(np.median(seconds)), factor)


# ---- the published frame


def published_frame_figures(path: Path) -> list[Figure]:
    """Localize frame.bmp at four rotations."""
    declared = [
        figure
        for name in (f"frame.bmp turned by {90 * k} deg" for k in range(4))
        for figure in (
            Figure(f"{name}: centre", None, "pitch", "", 0.05),
            Figure(f"{name}: heading", None, "deg", "", 0.2),
        )
    ]

    def measure() -> Iterator[Figure]:
        image = image_files.grey(image_files.decode(path.read_bytes()).pixels)
        for quarter in range(4):
            rotated = np.ascontiguousarray(np.rot90(image, quarter))
            located = localize_frames(rotated[None], codec("libdots"), other_codec_odds=0)
            error, heading_error = math.nan, math.nan
            if located.accepted[0]:
                error = float(np.abs(located.grid[0] - FRAME_BMP_CENTRE).max())
                # A rotation to the left moves the lower edge of the frame to the right.
                expected = math.radians(FRAME_BMP_HEADING_DEG - 90 * quarter)
                heading_error = abs(math.remainder(located.heading[0] - expected, math.tau))
                how = (
                    f"{located.dots[0]} dots, {located.corrected[0]} bits corrected; a libdots "
                    "sheet"
                )
            else:
                how = f"rejected: {located.rejected[0]}"
            centre, heading = declared[2 * quarter : 2 * quarter + 2]
            yield replace(centre, value=error, how=how)
            yield replace(heading, value=math.degrees(heading_error), how="of the same frame")

    return measure_or_explain(measure, *declared)


# ---- study of the paper's section IV on a simulated sheet: 121 positions and 36 angles


def study_figures() -> list[Figure]:
    """Measure errors and scatter by both methods, with a known lens, as in the paper.

    Errors refer to the truth of the simulation; those of the paper include its printer, its paper
    and its CNC machine.
    """
    raster = layout.snap(0.508, None, 300)
    page = layout.lay_out(paper_size("A3")[1], 5.0, raster)
    manifest = layout.manifest(raster, page.sheets("A3", (7_000_000, 9_000_000)), "anoto")
    middle = np.array(manifest.sheets[0].page_mm) * 0.5e-3
    offsets = np.linspace(-STUDY_SPAN_M / 2, STUDY_SPAN_M / 2, STUDY_GRID)
    positions = np.array([[x, y] for y in offsets for x in offsets]) + middle
    angles = np.radians(np.arange(STUDY_ANGLES) * 360 / STUDY_ANGLES)
    rows: list[Figure] = []
    for method in METHODS:
        over_positions = study_errors(manifest, positions, np.zeros(len(positions)), method)
        over_angles = study_errors(manifest, np.tile(middle, (STUDY_ANGLES, 1)), angles, method)
        rows += _study_rows(method, over_positions, over_angles)
    return rows


def study_errors(manifest: Manifest, positions: Array, headings: Array, method: str) -> Array:
    """Return errors (positions, samples, 3) of x and y [mm] and heading [deg]; nan if wrong."""
    position, heading = (np.repeat(part, STUDY_SAMPLES, axis=0) for part in (positions, headings))
    n = len(position)
    options = simulate.SimulationOptions(frames=n, jitter_m=STUDY_JITTER_M, seed=FIRST_SEED + 500)
    path = CameraPath(position, heading, np.zeros((n, 2)), np.zeros(n))
    simulated = simulate.simulate_path(manifest, options, path)
    solution = solve([simulated.frames], manifest, SolveOptions(method, simulated.camera))
    errors = np.full((n, 3), np.nan)
    for detection in solution.detections:
        k = int(detection.frame)
        errors[k, 0] = 1e3 * (detection.x_m - position[k, 0])
        errors[k, 1] = 1e3 * (detection.y_m - position[k, 1])
        heading_error = math.remainder(detection.heading_rad - heading[k], math.tau)
        errors[k, 2] = math.degrees(heading_error)
    is_wrong = np.abs(errors[:, :2]).max(axis=1) >= STUDY_MAX_ERROR_MM
    errors[is_wrong | (np.abs(errors[:, 2]) >= STUDY_MAX_ERROR_DEG)] = np.nan
    return errors.reshape(len(positions), STUDY_SAMPLES, 3)


def _study_rows(method: str, over_positions: Array, over_angles: Array) -> Iterator[Figure]:
    # Both methods have to read as many frames as the paper; the default method also has to be at
    # least as accurate.
    is_default = method == METHODS[0]
    label = "study" if is_default else f"study, --method {method}"
    is_correct = np.isfinite(over_positions[..., 0])
    yield Figure(
        f"{label}: frames right", 100 * float(is_correct.mean()), "%",
        f"{STUDY_GRID} x {STUDY_GRID} positions over 200 x 200 mm, {STUDY_SAMPLES} samples each: "
        f"{is_correct.size} frames", PAPER_RIGHT_PERCENT, "higher", "paper, its x",
        PAPER_RIGHT_PERCENT,
    )  # fmt: skip
    for axis, (name, (unit, paper_worst, paper_precision)) in enumerate(TABLE_III.items()):
        errors = (over_angles if name == "heading" else over_positions)[..., axis]
        read = np.isfinite(errors).any(axis=1)
        how = f"{int(read.sum())} of {len(errors)} {'angles' if axis == 2 else 'positions'}"
        largest = mean = precision = math.nan
        if read.any():
            absolute = np.abs(errors[np.isfinite(errors)])
            largest, mean = float(absolute.max()), float(absolute.mean())
            precision = float(np.nanstd(errors[read], axis=1).max())
        yield Figure(
            f"{label}: worst error {name}", largest, unit, how,
            paper_worst if is_default else None, "lower", STUDY_PEER, paper_worst,
        )  # fmt: skip
        yield Figure(f"{label}: mean error {name}", mean, unit, "of absolute values")
        yield Figure(
            f"{label}: precision {name}", precision, unit,
            "largest standard deviation at one of them",
            paper_precision if is_default else None, "lower", STUDY_PEER, paper_precision,
        )  # fmt: skip
