"""The simulator of dots against OpenCV's projection and drawing, and closed forms.

Nothing here solves a frame: what is held is that pictures and truth belong together.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec.pattern import DOWN, LEFT, RIGHT, UP, codec
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.dots.simulation import session as simulate
from locatk.core.dots.simulation.decoys import KINDS, decoys
from locatk.core.dots.simulation.optics import CameraPose, Exposer, Optics, frame_to_paper
from locatk.core.dots.simulation.paths import CameraPath, camera_path
from locatk.core.dots.simulation.session import METRES_PER_PX, SimulationOptions
from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion

Array = NDArray[np.float64]
PLAIN = SimulationOptions(
    frames=1, path="random", camera=simulate.camera(0.0), blur_px=0.0, noise=0.0
)
PITCH_PX = 0.508 / 0.046
BEYOND = {UP: (0, -1), LEFT: (-1, 0), RIGHT: (1, 0), DOWN: (0, 1)}


def at(x: float, y: float, heading: float, n: int = 1) -> CameraPath:
    """Standing at a place in metres."""
    return CameraPath(np.tile([x, y], (n, 1)), np.full(n, heading), np.zeros((n, 2)), np.zeros(n))


def one_dot() -> tuple[Manifest, Array]:
    """A sheet with a single dot, and where its ink is, in metres."""
    manifest = Manifest((Sheet("dot", (5_000, 70_000), (1, 1), (0, 0), (100.0, 100.0), (50, 50)),))
    symbol = int(codec("anoto").symbols((5_000, 70_000), (1, 1))[0, 0])
    x, y = BEYOND[symbol]
    return manifest, np.array([50 + x * 0.508 / 6, 50 - y * 0.508 / 6]) * 1e-3


def moments(frame: NDArray[np.uint8], paper: float = 210.0) -> tuple[Array, Array, float]:
    """Centre (x, y) and covariance (2, 2) in px of what is dark, and how much that is."""
    dark = paper - frame.astype(float)
    y, x = np.mgrid[: frame.shape[0], : frame.shape[1]]
    total = dark.sum()
    centre = np.array([(dark * x).sum(), (dark * y).sum()]) / total
    away = np.stack([x - centre[0], y - centre[1]])
    return centre, np.einsum("iyx,jyx,yx->ij", away, away, dark) / total, total


# ---- geometry


@pytest.mark.parametrize(("pitch", "roll"), [(0, 0), (0.17, 0), (0, -0.17), (0.12, 0.4)])
def test_the_view_is_a_pinhole_over_the_paper(pitch: float, roll: float) -> None:
    """The same camera set up in OpenCV's terms, placed by its truth alone."""
    heading, camera = 2.2, simulate.camera(0.0)
    optics = Optics(camera, METRES_PER_PX, 0, 210, 0.75, 0, 0, 0, 0)
    homography = frame_to_paper(optics, CameraPose(heading, pitch, roll))

    lean, _ = cv2.Rodrigues(np.array([pitch, 0.0, 0.0]))
    roll_only, _ = cv2.Rodrigues(np.array([0.0, roll, 0.0]))
    to_paper = np.diag([1.0, -1.0, -1.0]) @ lean @ roll_only
    distance = camera.focal_px * METRES_PER_PX
    intrinsic = np.array([[camera.focal_px, 0, 93.5], [0, camera.focal_px, 59.5], [0, 0, 1]])

    def project(points: Array, turn: float) -> Array:
        yaw, _ = cv2.Rodrigues(np.array([0.0, 0.0, turn]))
        axes = yaw @ to_paper
        rotation, _ = cv2.Rodrigues(axes.T)
        solid = np.c_[points, np.zeros(len(points))]
        shift = axes.T @ (distance * axes[:, 2])  # the pinhole lies behind the point it aims at
        image, _ = cv2.projectPoints(solid, rotation, shift, intrinsic, None)
        return np.asarray(image[:, 0])

    # Which yaw makes a step along the heading go right in the image: by bisection.
    ahead = 1e-6 * np.array([[math.cos(heading), math.sin(heading)]])

    def sinks(turn: float) -> float:
        return float(project(ahead, turn)[0, 1] - 59.5)

    low, high = heading - 0.5, heading + 0.5
    assert sinks(low) * sinks(high) < 0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if sinks(low) * sinks(middle) > 0 else (low, middle)
    assert project(ahead, low)[0, 0] > 93.5

    positions = np.random.default_rng(0).uniform(-3e-3, 3e-3, (50, 2))
    ours = np.c_[positions, np.ones(50)] @ np.linalg.inv(homography).T
    assert ours[:, :2] / ours[:, 2:] + camera.centre_px == pytest.approx(
        project(positions, low), abs=1e-5
    )


@pytest.mark.slow
def test_a_frame_is_what_opencv_draws_of_the_same_page() -> None:
    """Tilted, turned, distorted and blurred: circles on a fine page, warped, reduced."""
    camera = simulate.camera(0.045)
    options = replace(PLAIN, camera=camera, pitch_rad=0.15, roll_rad=-0.1, blur_px=0.8, dot=0.3)
    manifest = simulate.sheet()
    x, y, heading = 0.1034, 0.1721, -2.3
    sheet = manifest.sheets[0]
    frame = simulate.simulate_path(manifest, options, at(x, y, heading)).frames.images[0]

    # A page of 90 px a pitch about the place, stamped from letters and printed measures.
    fine, reach = 90, 15
    middle = np.array([1e3 * x, sheet.page_mm[1] - 1e3 * y])
    first = np.rint((middle - sheet.first_mm) / 0.508).astype(int) - reach
    origin = (sheet.origin[0] + int(first[0]), sheet.origin[1] + int(first[1]))
    symbols = codec("anoto").symbols(origin, (2 * reach, 2 * reach))
    page = np.full((2 * reach * fine, 2 * reach * fine), 255, np.uint8)
    rows, columns = np.mgrid[:fine, :fine] + 0.5
    for (row, column), symbol in np.ndenumerate(symbols):
        right, down = fine * (np.array(BEYOND[int(symbol)]) / 6 + 0.5)
        disc = np.hypot(columns - right, rows - down) <= 0.15 * fine
        page[row * fine :, column * fine :][:fine, :fine][disc] = 0

    # Paper mm -> page px, then frame px at eight times the size -> paper mm by the pinhole.
    to_page = np.array([[fine / 0.508, 0, 0], [0, fine / 0.508, 0], [0, 0, 1]])
    start = np.array(sheet.first_mm) + first * 0.508
    to_page[:2, 2] = (0.5 * fine - 0.5) - start * fine / 0.508
    observed = frame_to_paper(
        Optics(camera, METRES_PER_PX, 0, 0, 0, 0, 0, 0, 0), CameraPose(heading, 0.15, -0.1)
    )
    to_paper = np.array([[1e3, 0, middle[0]], [0, -1e3, middle[1]], [0, 0, 1]]) @ observed
    parts = 8
    v, u = (np.mgrid[: 120 * parts, : 188 * parts] + 0.5) / parts - 0.5
    rays = camera.undistort(np.stack([u, v], axis=-1)) - camera.centre_px
    met = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1) @ (to_page @ to_paper).T
    maps = (met[..., :2] / met[..., 2:]).astype(np.float32)
    large = cv2.remap(page, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR).astype(np.float32)
    large = cv2.GaussianBlur(large, (0, 0), 0.8 * parts, borderType=cv2.BORDER_REFLECT)
    small = cv2.resize(large, (188, 120), interpolation=cv2.INTER_AREA)
    drawn = 210 * (1 - 0.75 * (1 - small / 255))

    away = np.abs(frame.astype(float) - drawn)[4:-4, 4:-4]
    assert drawn.min() < 120
    assert away.mean() < 0.6  # rounding alone makes 0.25
    assert away.max() < 6


def test_each_dot_has_the_position_of_its_symbol_and_truth() -> None:
    """Straight down everything is a similarity, which is written out here."""
    manifest = simulate.sheet()
    simulated = simulate.simulate(manifest, replace(PLAIN, frames=3, blur_px=0.6))
    sheet = manifest.sheets[0]
    for frame, position, turn in zip(
        simulated.frames.images,
        simulated.truth.position,
        heading_from_quaternion(simulated.truth.quaternion),
        strict=True,
    ):
        middle = (
            np.array([1e3 * position[0], sheet.page_mm[1] - 1e3 * position[1]]) - sheet.first_mm
        )
        near = np.rint(middle / 0.508).astype(int)
        away: list[Array] = []
        symbols = codec("anoto").symbols(
            (sheet.origin[0] + int(near[0]) - 3, sheet.origin[1] + int(near[1]) - 3), (7, 7)
        )
        for (row, column), symbol in np.ndenumerate(symbols):
            grid = near + np.array([column - 3, row - 3]) + np.array(BEYOND[int(symbol)]) / 6
            right, down = (grid * 0.508 - middle) / 0.046
            # heading is counter-clockwise on paper with y up, so a dot turns clockwise back
            c, s = math.cos(turn), math.sin(turn)
            x, y = 93.5 + c * right - s * down, 59.5 + s * right + c * down
            px, py = round(x), round(y)
            assert 4 < px < 183
            assert 4 < py < 115
            centre, _, total = moments(frame[py - 3 : py + 4, px - 3 : px + 4])
            assert total > 500
            away.append(centre + (px - 3, py - 3) - (x, y))
        # Grey values are whole numbers, and neighbours reach into the cut a little.
        assert np.sqrt(np.mean(np.square(away))) < 0.03


@pytest.mark.slow
def test_the_published_frame_resembles_its_simulation(data: Path) -> None:
    """Codec, conventions and heading against the real picture of cellulo-localization."""
    real = cv2.imread(str(data / "dots" / "frame.bmp"), cv2.IMREAD_GRAYSCALE)
    manifest = Manifest(
        (Sheet("a", (100, 3200), (60, 50), (24, 32), (100, 100), (10, 10)),), codec="libdots"
    )
    options = replace(
        PLAIN,
        camera=Camera((320, 241), 5000.0, (159.5, 120.0)),
        metres_per_px=0.508e-3 / 20.18,
        dot=0.33,
        blur_px=1.0,
    )
    (position,) = manifest.to_metres(0, np.array([[129.168, 3224.506]]))

    def likeness(degrees: float) -> float:
        poses = at(*position, math.radians(degrees))
        frame = simulate.simulate_path(manifest, options, poses).frames.images[0]
        return float(np.corrcoef(frame.ravel(), real.ravel())[0, 1])

    assert likeness(1.603) > 0.8
    assert likeness(-1.603) < 0.4
    assert likeness(91.603) < 0.2


# ---- ink and light, by moments of a single dot


@pytest.mark.parametrize(
    ("options", "extra"),
    [
        ({}, 0.0),
        ({"dot": 1 / 6}, 0.0),
        ({"blur_px": 1.5}, 1.5**2),
        ({"motion_px": 6.0}, None),
    ],
    ids=["plain", "small", "blur", "motion"],
)
def test_a_dot_has_the_size_that_was_asked_for(
    options: dict[str, float], extra: float | None
) -> None:
    manifest, ink = one_dot()
    expected = replace(PLAIN, paper_level=200.0, contrast=1.0, **options)  # type: ignore[arg-type]
    frame = simulate.simulate_path(manifest, expected, at(*ink, 0.4)).frames.images[0]
    centre, spread, total = moments(frame, 200.0)
    radius = expected.dot * PITCH_PX / 2
    assert centre == pytest.approx((93.5, 59.5), abs=0.02)
    assert total / 200 == pytest.approx(math.pi * radius**2, rel=0.02)
    # A disc spreads by r^2 / 4 an axis, and a pixel by 1 / 12.
    alone = radius**2 / 4 + 1 / 12
    if extra is not None:
        assert spread == pytest.approx((alone + extra) * np.eye(2), abs=0.06 * (1 + extra))
    else:
        narrow, wide = np.linalg.eigvalsh(spread)
        assert narrow == pytest.approx(alone, abs=0.06)
        assert wide == pytest.approx(alone + 36 / 12, rel=0.05)


def test_motion_blur_follows_speed_and_exposure() -> None:
    manifest, ink = one_dot()
    options = replace(PLAIN, exposure_s=2e-3, paper_level=200.0, contrast=1.0)
    velocity_mps = np.array([[0.1 * math.cos(0.9), 0.1 * math.sin(0.9)]])
    driven = replace(at(*ink, 0.9), velocity_mps=velocity_mps)
    frame = simulate.simulate_path(manifest, options, driven).frames.images[0]
    centre, spread, _ = moments(frame, 200.0)
    assert centre == pytest.approx((93.5, 59.5), abs=0.02)
    radius = options.dot * PITCH_PX / 2
    length = 0.1 * 2e-3 / METRES_PER_PX
    # The way is along the heading, which is right in the image.
    assert spread[0, 0] == pytest.approx(radius**2 / 4 + 1 / 12 + length**2 / 12, rel=0.05)
    assert spread[1, 1] == pytest.approx(radius**2 / 4 + 1 / 12, abs=0.06)
    turning = replace(at(*(ink + [2e-3, 0]), 0.0), yaw_rate_rps=np.array([100.0]))
    frame = simulate.simulate_path(manifest, options, turning).frames.images[0]
    _, spread, _ = moments(frame, 200.0)
    arc = 2e-3 / METRES_PER_PX * 100 * 2e-3
    assert spread[1, 1] == pytest.approx(radius**2 / 4 + 1 / 12 + arc**2 / 12, rel=0.05)


def test_light_falls_to_the_corners_and_to_one_side() -> None:
    blank = replace(PLAIN, contrast=0.0, paper_level=200.0)

    def frame(**more: float) -> Array:
        options = replace(blank, **more)  # type: ignore[arg-type]
        return simulate.simulate(None, options).frames.images[0].astype(float)

    dim = frame(vignette=0.4)
    assert dim[59:61, 93:95] == pytest.approx(200, abs=1)
    assert [dim[0, 0], dim[-1, 0], dim[0, -1], dim[-1, -1]] == pytest.approx([120] * 4, abs=1)
    assert dim[60, 0] > dim[0, 0]
    slope = frame(gradient=0.2)
    assert slope.max() - slope.min() == pytest.approx(80, abs=2)
    assert slope[0, 0] + slope[-1, -1] == pytest.approx(400, abs=2)


def test_noise_has_its_strength_and_moves_no_pose() -> None:
    quiet, loud = (
        simulate.simulate(None, replace(PLAIN, noise=sigma, paper_level=128)) for sigma in (0, 9)
    )
    apart = loud.frames.images[0].astype(float) - quiet.frames.images[0]
    assert apart.std() == pytest.approx(9, rel=0.03)
    assert abs(apart.mean()) < 0.3
    assert np.array_equal(quiet.truth.position, loud.truth.position)


# ---- the printer


def darkness(manifest: Manifest | None, **more: float) -> Array:
    options = replace(PLAIN, frames=30, **more)  # type: ignore[arg-type]
    frames = simulate.simulate(manifest, options).frames.images
    return np.array([1 - np.mean(frame) / 210 for frame in frames]) / 0.75


@pytest.mark.slow
def test_dots_are_missing_and_dust_is_there_by_their_share() -> None:
    full = darkness(None)
    assert full.mean() == pytest.approx(math.pi * 0.15**2, rel=0.01)
    assert darkness(None, missing=0.2).mean() == pytest.approx(0.8 * full.mean(), rel=0.03)
    assert darkness(None, missing=1.0) == pytest.approx(0, abs=1e-9)
    low, high = 0.05, 0.2
    speck = math.pi * (high**3 - low**3) / 3 / (high - low)
    assert darkness(None, missing=1.0, dust=0.3).mean() == pytest.approx(0.3 * speck, rel=0.1)


def test_a_dot_that_is_missing_is_missing_in_every_frame() -> None:
    options = replace(PLAIN, missing=0.3, dust=0.2, jitter_m=2e-5)
    manifest = simulate.sheet()
    here = simulate.simulate_path(manifest, options, at(0.1, 0.1, 0.0)).frames.images[0]
    eight_px = 8 * METRES_PER_PX
    there = simulate.simulate_path(manifest, options, at(0.1 + eight_px, 0.1, 0.0)).frames.images[0]
    assert np.abs(here[:, 8:].astype(int) - there[:, :-8]).max() <= 1
    other = simulate.simulate_path(
        manifest, replace(options, seed=1), at(0.1, 0.1, 0.0)
    ).frames.images[0]
    assert np.abs(here.astype(int) - other).max() > 100


@pytest.mark.slow
def test_dots_stray_by_the_jitter_that_was_asked_for() -> None:
    manifest, ink = one_dot()
    options = replace(PLAIN, jitter_m=1e-4)
    strays = []
    for seed in range(60):
        frame = simulate.simulate_path(
            manifest, replace(options, seed=seed), at(*ink, 0.0)
        ).frames.images[0]
        strays.append(moments(frame)[0] - (93.5, 59.5))
    assert np.std(strays, axis=0) * METRES_PER_PX == pytest.approx([1e-4, 1e-4], rel=0.15)
    assert np.abs(np.corrcoef(np.transpose(strays))[0, 1]) < 0.25


def test_only_the_truth_contains_the_scale_of_the_printer() -> None:
    manifest = simulate.sheet()
    stretched = replace(manifest, scale=(1.004, 0.997))
    options = replace(PLAIN, frames=4)
    unknown = simulate.simulate(manifest, replace(options, printer_scale=(1.004, 0.997)))
    known = simulate.simulate(stretched, options)
    assert unknown.manifest.scale == (1, 1)
    assert np.array_equal(unknown.truth.position, known.truth.position)
    assert np.array_equal(list(unknown.frames.images), list(known.frames.images))
    # A dot 150 mm from the left is printed 0.6 mm further out.
    position = (150.0, 200.0)
    far = Sheet("dot", (5_000, 70_000), (1, 1), (0, 0), (210.0, 297.0), (position[0], position[1]))
    one = Manifest((far,))
    observed = replace(options, printer_scale=(1.004, 0.997), frames=1)
    x, y = position[0] * 1.004e-3, (297 - position[1]) * 0.997e-3
    centre, _, _ = moments(simulate.simulate_path(one, observed, at(x, y, 0.0)).frames.images[0])
    dot = one_dot()[1] * 1e3 - 50
    assert (centre - (93.5, 59.5)) * 0.046 == pytest.approx(
        (dot[0] * 1.004, -dot[1] * 0.997), abs=1e-3
    )


# ---- sheets


def test_the_later_of_overlapping_tiles_is_on_top() -> None:
    page = (50.0, 50.0)
    tiles = Manifest(
        (
            Sheet("left", (100, 100), (80, 80), (0, 0), page, (5, 5), (0.0, 0.0)),
            Sheet("right", (900, 700), (80, 80), (0, 0), page, (5, 5), (40.0, 0.0), 5.0),
        )
    )
    alone = [replace(tiles, sheets=(tile,)) for tile in tiles.sheets]
    left, right, both = (
        simulate.simulate_path(m, PLAIN, at(0.0447, 0.025, 0.3)).frames.images[0].astype(int)
        for m in (*alone, tiles)
    )
    assert (left < 100).any()
    assert (right < 100).any()
    assert np.all(both >= np.minimum(left, right) - 1)
    # Where the right tile has dots, nothing of the left one is seen.
    assert np.all(both[right < 100] <= right[right < 100])
    assert (both[:, -40:] == right[:, -40:]).all()
    assert simulate.simulate(tiles, PLAIN).truth.frame == "floor"
    # Turned by five degrees: what one sees under it is what one saw on the paper.
    flat = Manifest((replace(tiles.sheets[1], position_mm=None, heading_deg=0.0),))
    rotated = np.radians(5)
    point = np.array([0.02, 0.03])
    c, s = math.cos(rotated), math.sin(rotated)
    moved = np.array([[c, -s], [s, c]]) @ point + [0.04, 0.0]
    there = (
        simulate.simulate_path(alone[1], PLAIN, at(*moved, 0.3 + rotated))
        .frames.images[0]
        .astype(int)
    )
    here = simulate.simulate_path(flat, PLAIN, at(*point, 0.3)).frames.images[0]
    assert np.abs(there - here).max() <= 1


def test_beyond_a_sheet_there_is_paper_only() -> None:
    frame = simulate.simulate_path(simulate.sheet(), PLAIN, at(0.5, 0.5, 0.0)).frames.images[0]
    assert (frame == 210).all()


@pytest.mark.parametrize("number", [-1, 1])
def test_a_sheet_that_is_not_there_is_refused(number: int) -> None:
    with pytest.raises(InputError, match="sheet number"):
        simulate.simulate(None, replace(PLAIN, sheet=number))


# ---- paths and sessions


def test_a_curve_has_constant_speed_and_faces_forward() -> None:
    options = replace(PLAIN, path="curve", frames=2000, rate_hz=100.0, speed_mps=0.25)
    truth = simulate.simulate(None, options).truth
    step = np.diff(truth.position[:, :2], axis=0)
    assert np.linalg.norm(step, axis=1) == pytest.approx(np.full(1999, 0.0025), rel=0.01)
    ahead = np.exp(1j * heading_from_quaternion(truth.quaternion))
    mean = ahead[:-1] + ahead[1:]
    assert np.abs(np.angle((step[:, 0] + 1j * step[:, 1]) / mean)).max() < 0.02
    assert (truth.position.min(axis=0)[:2] > [0.008, 0.008]).all()
    assert (truth.position.max(axis=0)[:2] < [0.202, 0.289]).all()
    assert np.diff(truth.time_ns) == pytest.approx(1e7, abs=1)
    # It goes all over the sheet.
    assert (np.ptp(truth.position, axis=0)[:2] > [0.15, 0.15]).all()


def test_a_curve_knows_how_it_moves() -> None:
    time_s = np.arange(0, 20, 1e-3)
    driven = camera_path("curve", time_s, np.zeros(2), np.array([0.3, 0.2]), 0.2, seed=5)
    velocity = np.gradient(driven.position_m, time_s, axis=0)[1:-1]
    assert np.abs(velocity - driven.velocity_mps[1:-1]).max() < 0.002
    rate = np.gradient(np.unwrap(driven.heading_rad), time_s)[1:-1]
    assert np.abs(rate - driven.yaw_rate_rps[1:-1]).max() < 0.05 * np.abs(rate).max()


def test_random_frames_are_anywhere_and_still_ones_are_not() -> None:
    many = simulate.simulate(None, replace(PLAIN, frames=400)).truth
    heading = heading_from_quaternion(many.quaternion)
    assert abs(np.exp(1j * heading).mean()) < 0.15
    assert np.ptp(many.position[:, 0]) > 0.17
    still = simulate.simulate(None, replace(PLAIN, frames=5, path="still", noise=2.0))
    assert (still.truth.position == still.truth.position[0]).all()
    first, second = still.frames.images[0].astype(int), still.frames.images[1].astype(int)
    assert 0 < np.abs(first - second).mean() < 5


def test_the_same_options_give_the_same_session_in_any_order() -> None:
    options = SimulationOptions(
        frames=4, tilt_rad=0.1, missing=0.05, dust=0.05, jitter_m=1e-5, gradient=0.1, seed=3
    )
    one, two = simulate.simulate(None, options), simulate.simulate(None, options)
    frames = list(one.frames.images)
    assert all(frame.dtype == np.uint8 and frame.shape == (120, 188) for frame in frames)
    for number in (3, 0, 2, 1):
        assert np.array_equal(two.frames.images[number], frames[number])
    assert np.array_equal(two.frames.images[-1], frames[3])
    assert len(two.frames.images[1:]) == 3
    with pytest.raises(IndexError):
        two.frames.images[4]
    assert one.frames.names == ("0", "1", "2", "3")
    other = simulate.simulate(None, replace(options, seed=4))
    assert not np.array_equal(other.frames.images[0], frames[0])


def test_each_frame_is_tilted_up_to_the_limit() -> None:
    simulated = simulate.simulate(None, replace(PLAIN, frames=300, tilt_rad=0.17))
    poses = simulated.frames.images._poses  # type: ignore[attr-defined]
    tilt = np.array([math.hypot(s.pitch_rad, s.roll_rad) for s in poses])
    assert tilt.max() <= 0.17
    assert tilt.max() > 0.16
    assert tilt.min() < 0.01
    assert abs(np.mean([s.pitch_rad for s in poses])) < 0.02


@pytest.mark.parametrize(
    "wrong",
    [
        {"frames": 0},
        {"rate_hz": 0.0},
        {"path": "spiral"},
        {"speed_mps": -1.0},
        {"exposure_s": 1.0},
        {"motion_px": -1.0},
        {"metres_per_px": 0.0},
        {"tilt_rad": 0.5, "pitch_rad": 0.5},
        {"dot": 0.0},
        {"dot": 0.9},
        {"missing": 1.1},
        {"dust": -0.1},
        {"jitter_m": 1.0},
        {"printer_scale": (1.0, 100.0)},
        {"blur_px": -1.0},
        {"noise": math.nan},
        {"paper_level": 300.0},
        {"contrast": 2.0},
        {"vignette": -0.1},
        {"gradient": 1.5},
        {"seed": -1},
        {"camera": Camera((188, 120), 348.0, (93.5, 59.5), -30.0)},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_impossible_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        SimulationOptions(**wrong)  # type: ignore[arg-type]


# ---- decoys


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_decoys_are_frames_and_differ(kind: str) -> None:
    frames = decoys(kind, 6, seed=1)
    assert frames.shape == (6, 120, 188)
    assert frames.dtype == np.uint8
    assert np.array_equal(frames, decoys(kind, 6, seed=1))
    assert not np.array_equal(frames, decoys(kind, 6, seed=2))
    assert len({frame.tobytes() for frame in frames}) > 3
    if kind != "blank":
        assert all(frame.std() > 2 for frame in frames)
    assert decoys(kind, 1, seed=1, size=(64, 48)).shape == (1, 48, 64)


def test_random_symbols_are_the_pattern_but_for_the_code() -> None:
    """Dark at as many places as a true frame, about one a pitch squared."""
    for frame in decoys("random symbols", 5, seed=3):
        smooth = cv2.GaussianBlur(frame, (0, 0), 1.5).astype(int)
        lowest = smooth == cv2.erode(smooth.astype(np.uint8), np.ones((7, 7), np.uint8))
        dots = (lowest & (smooth < np.median(smooth) - 15)).sum()
        assert dots > 0.6 * 188 * 120 / PITCH_PX**2


def test_unknown_decoys_are_refused() -> None:
    with pytest.raises(InputError, match="no decoys"):
        decoys("cats", 1, 0)


def test_an_exposer_needs_no_marks() -> None:
    exposer = Exposer(Optics(simulate.camera(), METRES_PER_PX, 0.6, 210, 0.75, 0, 0, 0, 0))
    frame = exposer.expose(CameraPose(0.0), np.zeros((0, 2)), np.zeros(0), np.random.default_rng(0))
    assert (frame == 210).all()
