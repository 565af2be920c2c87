"""The figures of the dots: frames that were rendered, read one by one, and the real one.

Frames are like those on which cellulo-localization was measured: 188 x 120 px of 0.046 mm over a
grid of 0.508 mm, anywhere on a sheet and at any rotation, blurred by 0.6 px, with noise of 2 grey
values, dots of 0.30 pitches and an ideal lens where a row does not say otherwise. Each is read
cold, for itself. A place is right within half a pitch and five degrees.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import (
    LocalizedFrames,
    localize_frames,
    unlocalized_frames,
)
from locatk.core.dots.sheet import Manifest
from locatk.core.dots.simulation import session as simulate
from locatk.core.dots.simulation.decoys import KINDS, decoys
from locatk.core.dots.solver import SolveOptions, solve
from locatk.core.errors import LocatkError
from locatk.core.geometry import heading_from_quaternion
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.dots.printing import codec_figures, page, print_figures
from locatk.formats.benchmarks.dots.published_study import study_figures
from locatk.formats.benchmarks.timing import SEED, cpu_seconds, measured

Array = NDArray[np.float64]

FRAMES = 1000
"""Of each condition, and behind each measure of speed."""

DECOYS = 500
"""Of each kind of frames without the pattern."""

PAPER_FRAMES = 200
"""The same for the published method, which reads frame by frame."""

CELLULO = "cellulo-localization"
LENS = simulate.camera()
FLAT = simulate.camera(0.0)

REAL_CENTRE = (129.168, 3224.506)
REAL_HEADING_DEG = 1.603
"""Centre [pitches] and heading of frame.bmp, the image a.bmp of cellulo-localization, decoded by a
prototype and confirmed by the decoder of that repository."""


@dataclass(frozen=True)
class Condition:
    """What frames are rendered with, and what is promised and known of them, in percent."""

    name: str
    options: dict[str, Any] = field(default_factory=dict)
    target: float | None = None
    peer_value: float | None = None
    peer: str = f"{CELLULO}, warm"
    rms_target: float | None = None
    rms_peer: float | None = None
    camera: Camera | None = None
    """What the reader knows of the camera."""


COLD = f"{CELLULO}, cold: 74-78"
TEN_DEGREES = {"tilt_rad": math.radians(10)}

CONDITIONS = (
    Condition("dots 0.25", {"dot": 0.25}, 100.0, 78.0, COLD, 0.003, 0.050),
    Condition("dots 0.30", {}, 100.0, 78.0, COLD, 0.003, 0.050),
    Condition("dots 0.35", {"dot": 0.35}, 100.0, 78.0, COLD, 0.003, 0.050),
    Condition("dots 1/6", {"dot": 1 / 6}, 99.0, 0.7),
    Condition("2 % missing", {"missing": 0.02}, 99.5, 83.0),
    Condition("5 % missing", {"missing": 0.05}, 99.0, 62.0),
    Condition("10 % missing", {"missing": 0.10}, 97.0, 31.0),
    Condition("blur 2.2 px", {"blur_px": 2.2}, 99.0, 92.5),
    Condition("vignette 0.4", {"vignette": 0.4}, 100.0, 100.0),
    Condition("noise 16", {"noise": 16.0}, 100.0, 100.0),
    Condition("tilt to 10 deg", TEN_DEGREES, 99.0),
    Condition("paper's lens", {"camera": LENS}, 99.0, camera=LENS),
    Condition("paper's lens, not calibrated", {"camera": LENS}, 99.0),
    Condition("paper's lens, tilt to 10 deg", {"camera": LENS, **TEN_DEGREES}, 99.0, camera=LENS),
    Condition(
        "paper's lens, tilt to 10 deg, not calibrated", {"camera": LENS, **TEN_DEGREES}, 99.0
    ),
    Condition("motion blur 2 px", {"motion_px": 2.0}),
    Condition("5 % dust", {"dust": 0.05}),
    Condition("printer's jitter 10 um", {"jitter_m": 10e-6}),
)


def figures(data: Path) -> list[Figure]:
    """All figures of dots; ``data`` is the folder of published recordings."""
    return [
        *codec_figures(),
        *print_figures(),
        *condition_figures(),
        *decoy_figures(),
        *paper_method_figures(),
        *speed_figures(),
        *real_figures(data / "dots" / "frame.bmp"),
        *study_figures(),
    ]


# ---- conditions


@dataclass(frozen=True)
class Score:
    """How frames were read: counts, and errors in pitches of those that are right."""

    frames: int
    right: int
    wrong: int
    rms: float

    @property
    def wrong_share(self) -> float:
        """Percent of the accepted."""
        return 100 * self.wrong / max(self.right + self.wrong, 1)


def render(
    condition: Condition, n: int, seed: int, manifest: Manifest
) -> tuple[NDArray[np.uint8], Array, Array]:
    """Frames (n, h, w), and true grid coordinates (n, 2) and headings (n,)."""
    options = simulate.SimulationOptions(
        frames=n, path="random", seed=seed, **{"camera": FLAT, **condition.options}
    )
    simulated = simulate.simulate(manifest, options)
    start = manifest.to_metres(0, manifest.sheets[0].origin)
    away = simulated.truth.position[:, :2] - start
    grid = away @ np.linalg.inv(manifest.jacobian(0)).T + manifest.sheets[0].origin
    return (
        np.array(list(simulated.frames.images)),
        grid,
        heading_from_quaternion(simulated.truth.quaternion),
    )


def score(located: LocalizedFrames, grid: Array, heading: Array) -> Score:
    """Compare with the truth."""
    accepted = located.accepted
    away = located.grid - grid
    turned = np.angle(np.exp(1j * (located.heading - heading)))
    near = (np.abs(away).max(axis=1) < 0.5) & (np.abs(turned) < math.radians(5))
    right = accepted & near
    rms = np.sqrt(np.mean(away[right] ** 2, axis=0)).max() if right.any() else math.nan
    return Score(len(grid), int(right.sum()), int((accepted & ~near).sum()), float(rms))


def condition_figures() -> list[Figure]:
    """A share that is right, an error and a share that is wrong for each condition."""
    manifest = page("A0")
    rows: list[Figure] = []
    right = wrong = 0
    for number, condition in enumerate(CONDITIONS):
        images, grid, heading = render(condition, FRAMES, SEED + 100 + number, manifest)
        found = score(
            localize_frames(images, codec(manifest.codec), condition.camera), grid, heading
        )
        rows += _rows(condition, found)
        right, wrong = right + found.right, wrong + found.wrong
    share = 100 * wrong / max(right + wrong, 1)
    rows.append(
        Figure(
            "all conditions: wrong among accepted", share, "%", f"{wrong} of {right + wrong}", 0.1
        )
    )
    return rows


def _rows(condition: Condition, found: Score) -> Iterator[Figure]:
    known = condition.peer_value is not None
    peer = condition.peer if known else None
    yield Figure(
        f"{condition.name}: right", 100 * found.right / found.frames, "%",
        f"of {found.frames} frames, each cold", condition.target, "higher",
        peer, condition.peer_value,
    )  # fmt: skip
    yield Figure(
        f"{condition.name}: rms", found.rms, "pitch",
        "the larger of x and y, of the right ones", condition.rms_target, "lower",
        f"{CELLULO}; 0.008 with its centre corrected" if condition.rms_peer else None,
        condition.rms_peer,
    )  # fmt: skip
    yield Figure(
        f"{condition.name}: wrong among accepted", found.wrong_share, "%",
        f"{found.wrong} of {found.right + found.wrong}", 0.1, "lower",
        peer and "the same, says nothing", 100 - condition.peer_value if known else None,  # type: ignore[operator]
    )  # fmt: skip


def decoy_figures() -> list[Figure]:
    """Frames of something else that are taken for the pattern, by kind."""
    rows, total = [], 0
    for kind in KINDS:
        accepted = int(
            localize_frames(decoys(kind, DECOYS, SEED + 200), codec("anoto")).accepted.sum()
        )
        total += accepted
        rows.append(
            Figure(f"{kind}: accepted", 100 * accepted / DECOYS, "%", f"{accepted} of {DECOYS}",
                   0.1, peer=CELLULO, peer_value=100.0)
        )  # fmt: skip
    count = DECOYS * len(KINDS)
    return [
        *rows,
        Figure("all without the pattern: accepted", 100 * total / count, "%",
               f"{total} of {count}", 0.1, peer=CELLULO, peer_value=100.0),
    ]  # fmt: skip


def paper_method_figures() -> list[Figure]:
    """The published algorithm on the frames that it was made for."""
    manifest = page("A0")
    rows = []
    for condition in (CONDITIONS[1], CONDITIONS[6]):
        images, grid, heading = render(condition, PAPER_FRAMES, SEED + 300, manifest)
        found = score(_by_solve(images, manifest, "paper"), grid, heading)
        name = f"--method paper, {condition.name}"
        rows += [
            Figure(f"{name}: right", 100 * found.right / found.frames, "%",
                   f"of {found.frames} frames", None, "higher",
                   condition.peer, condition.peer_value),
            Figure(f"{name}: rms", found.rms, "pitch", "the larger of x and y, of the right ones",
                   peer=CELLULO if condition.rms_peer else None, peer_value=condition.rms_peer),
            Figure(f"{name}: wrong among accepted", found.wrong_share, "%",
                   f"{found.wrong} of {found.right + found.wrong}"),
        ]  # fmt: skip
    return rows


def _by_solve(images: NDArray[np.uint8], manifest: Manifest, method: str) -> LocalizedFrames:
    """Frames solved as a session of them is; places again in grid coordinates."""
    n = len(images)
    frames = Frames("camera", np.arange(n), tuple(map(str, range(n))), list(images))
    solution = solve([frames], manifest, SolveOptions(method))
    located = unlocalized_frames(n, "rejected")
    for found in solution.detections:
        k = int(found.frame)
        located.grid[k] = found.grid_x, found.grid_y
        located.heading[k] = found.heading_rad
        located.rejected[k] = ""
    return located


# ---- speed


def speed_figures() -> list[Figure]:
    """Frames a second in a batch, and time of a single one."""
    return [
        measured("frames a second, in a batch", "1/s", f"dots.suite.batch_speed({FRAMES})", 1.0,
                 f"localize_frames() of {FRAMES} frames of 188 x 120 px, one thread, best of 3",
                 4000.0, "higher", CELLULO, 4000.0),
        measured("a single frame", "ms", f"dots.suite.single_time({min(FRAMES, 200)})", 1e3,
                 "localize_frames() of one frame, median, one thread", 0.5, "lower", CELLULO, 0.26),
    ]  # fmt: skip


def batch_speed(frames: int) -> tuple[float]:
    """Frames a second of processor time."""
    images, _, _ = render(CONDITIONS[1], frames, SEED + 400, page("A0"))
    table = codec("anoto")
    return (frames / cpu_seconds(lambda: localize_frames(images, table), 3),)


def single_time(frames: int) -> tuple[float]:
    """Seconds of processor time for a frame that comes alone, the median of some."""
    images, _, _ = render(CONDITIONS[1], frames, SEED + 401, page("A0"))
    table = codec("anoto")
    times = [
        cpu_seconds(lambda one=image[None]: localize_frames(one, table), 3)  # type: ignore[misc]
        for image in images
    ]
    return (float(np.median(times)),)


# ---- the published frame


def real_figures(path: Path) -> list[Figure]:
    """frame.bmp as it is and turned by quarters."""
    names = [f"frame.bmp turned by {90 * k} deg" for k in range(4)]
    try:
        frame = _grey(path)
    except (LocatkError, OSError) as error:
        how = f"not measured: {error}"
        return [
            row
            for name in names
            for row in (
                Figure(f"{name}: centre", None, "pitch", how, 0.05),
                Figure(f"{name}: heading", None, "deg", how, 0.2),
            )
        ]
    rows = []
    for quarter, name in enumerate(names):
        located = localize_frames(
            np.ascontiguousarray(np.rot90(frame, quarter))[None], codec("libdots")
        )
        how = f"{located.dots[0]} dots, {located.corrected[0]} bits corrected; a libdots sheet"
        away, turned = math.nan, math.nan
        if located.accepted[0]:
            away = float(np.abs(located.grid[0] - REAL_CENTRE).max())
            # Turned to the left, the frame's right is what was down before.
            expected = math.radians(REAL_HEADING_DEG - 90 * quarter)
            turned = abs(math.remainder(located.heading[0] - expected, math.tau))
        else:
            how = f"rejected: {located.rejected[0]}"
        rows += [
            Figure(f"{name}: centre", away, "pitch", how, 0.05),
            Figure(f"{name}: heading", math.degrees(turned), "deg", "the same", 0.2),
        ]
    return rows


def _grey(path: Path) -> NDArray[np.uint8]:
    from locatk.formats import images

    return images.grey(images.decode(path.read_bytes()).pixels)
