"""Cameras from frames: those of the simulator, and some that OpenCV projects and draws."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.calibration import camera as calibration
from locatk.core.dots.calibration import camera_views
from locatk.core.dots.calibration.camera import CalibrateOptions, CameraReport, calibrate
from locatk.core.dots.calibration.camera_views import (
    CalibrationFrame,
    select_diverse_frames,
    spread_order,
)
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.simulation import session as simulate
from locatk.core.dots.simulation.session import SimulationOptions
from locatk.core.dots.solver import SolveOptions, solve
from locatk.core.errors import DegenerateError, InputError
from locatk.core.simulation import SESSION_START_NS

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Lens = Callable[[Array], Array]

SIZE = (188, 120)
TRUTH = Camera(SIZE, 360.0, (96.2, 57.1), -0.45)
MANIFEST = simulate.sheet()


def simulated(
    frames: int = 25, camera: Camera = TRUTH, **more: object
) -> simulate.SimulatedSession:
    options = SimulationOptions(frames=frames, path="random", camera=camera, **more)  # type: ignore[arg-type]
    session = simulate.simulate(MANIFEST, options)
    return replace(session, frames=replace(session.frames, images=list(session.frames.images)))


@pytest.fixture(scope="module")
def tilted() -> simulate.SimulatedSession:
    return simulated(tilt_rad=math.radians(10))


@pytest.fixture(scope="module")
def upright() -> simulate.SimulatedSession:
    return simulated(seed=1)


@pytest.fixture(scope="module")
def upright_report(upright: simulate.SimulatedSession) -> CameraReport:
    return calibrate(upright.frames, MANIFEST)


def check_lens(report: CameraReport, camera: Camera = TRUTH) -> None:
    assert report.camera.size == camera.size
    assert report.camera.centre_px == pytest.approx(camera.centre_px, abs=0.2)
    assert report.camera.radial_px == pytest.approx(camera.radial_px, rel=0.02)


# ---- frames that OpenCV draws


def division(k: float) -> Lens:
    """Where a lens shows what belongs at an offset: r / (1 + k r^2) turned round by a table."""
    r = np.linspace(0, min(400.0, 0.98 / math.sqrt(abs(k))), 400_000)
    ideal = r / (1 + k * r * r)

    def bend(offset: Array) -> Array:
        length = np.linalg.norm(offset, axis=-1, keepdims=True)
        return offset * np.interp(length, ideal, r) / np.maximum(length, 1e-9)

    return bend


def polynomial(k1: float, k2: float, focal: float) -> Lens:
    """The usual lens of OpenCV."""

    def bend(offset: Array) -> Array:
        square = (offset**2).sum(axis=-1, keepdims=True) / focal**2
        return offset * (1 + square * (k1 + square * k2))

    return bend


def drawn(
    frames: int,
    lens: Lens,
    *,
    size: tuple[int, int] = SIZE,
    focal: float = 360.0,
    centre: tuple[float, float] = TRUTH.centre_px,
    mm_per_px: float = 0.046,
    tilt_deg: float = 10.0,
    skew: float = 0.0,
    seed: int = 0,
) -> Frames:
    """Frames of polygons about dots, projected by OpenCV and drawn eight times finer.

    ``skew`` shifts each row by that share of its distance from the first, to one side or
    the other: what a rolling shutter makes of motion.
    """
    rng = np.random.default_rng(seed)
    fine, around = 8, np.linspace(0, 2 * math.pi, 16, endpoint=False)
    intrinsic = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    reach = int(0.75 * math.hypot(*size) * mm_per_px / 0.508) + 2
    images = []
    for _ in range(frames):
        first = np.array(MANIFEST.sheets[0].origin) + rng.integers(0, 300, 2)
        symbols = codec("anoto").symbols((int(first[0]), int(first[1])), (2 * reach, 2 * reach))
        rows, columns = np.mgrid[: 2 * reach, : 2 * reach] - reach + rng.uniform(-0.5, 0.5)
        aside = np.array([[0, -1], [-1, 0], [1, 0], [0, 1]])[symbols] / 6
        dots = (np.stack([columns, rows], axis=-1) + aside).reshape(-1, 1, 2) * 0.508
        rims = dots + 0.15 * 0.508 * np.stack([np.cos(around), np.sin(around)], axis=-1)
        solid = np.concatenate([rims.reshape(-1, 2), np.zeros((rims.size // 2, 1))], axis=1)

        tilt, towards = math.radians(tilt_deg) * rng.uniform(0.2, 1), rng.uniform(-4, 4)
        lean, _ = cv2.Rodrigues(tilt * np.array([math.cos(towards), math.sin(towards), 0.0]))
        spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-4, 4)]))
        rotation, _ = cv2.Rodrigues(lean @ spin)
        flat, _ = cv2.projectPoints(
            solid, rotation, np.array([0, 0, focal * mm_per_px]), intrinsic, None
        )
        observed = lens(flat[:, 0] - centre) + centre
        observed[:, 0] += rng.choice([-1, 1]) * skew * observed[:, 1]
        canvas = np.full((size[1] * fine, size[0] * fine), 215, np.uint8)
        # Pixel centres are whole numbers in both pictures; 4 bits are fractions.
        corners = np.rint(((observed + 0.5) * fine - 0.5) * 16).astype(np.int32).reshape(rims.shape)
        for polygon in corners:
            if (polygon > -800).all() and (polygon < 16 * fine * (max(size) + 6)).all():
                cv2.fillPoly(canvas, [polygon], 60, shift=4)
        image = cv2.GaussianBlur(
            cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), (0, 0), 0.6
        )
        images.append(np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    return as_frames(images)


def as_frames(images: Sequence[Image]) -> Frames:
    time_ns = SESSION_START_NS + 20_000_000 * np.arange(len(images))
    return Frames("camera", time_ns, tuple(map(str, range(len(images)))), images)


# ---- the camera


@pytest.mark.slow
def test_the_simulators_camera_comes_back(tilted: simulate.SimulatedSession) -> None:
    report = calibrate(tilted.frames, MANIFEST)
    check_lens(report)
    assert report.camera.focal_px == pytest.approx(TRUTH.focal_px, rel=0.01)
    assert (report.focal_from, report.centre_from) == ("frames", "frames")
    assert report.rms_px < 0.05 < 0.3 < report.rms_before_px
    assert report.distortion == pytest.approx(0.0432, abs=0.001)
    assert 8 < math.degrees(report.largest_tilt_rad) < 10.2
    assert (report.seen, report.located, report.used, report.skipped) == (25, 25, 25, {})
    assert report.dots > 25 * 150
    assert report.notes == ()
    assert report.sigma_focal_px < 0.01 * TRUTH.focal_px
    assert max(report.sigma_centre_px) < 0.1
    error = abs(report.camera.radial_px - TRUTH.radial_px)
    assert error < 5 * report.sigma_radial_px < 0.02 * abs(TRUTH.radial_px)
    assert report.sigma_radial == pytest.approx(report.sigma_radial_px * report.camera.focal_px**2)


@pytest.mark.slow
def test_a_camera_of_opencv_comes_back() -> None:
    report = calibrate(drawn(16, division(TRUTH.radial_px)), MANIFEST)
    check_lens(report)
    assert report.camera.focal_px == pytest.approx(360.0, rel=0.02)
    assert report.rms_px < 0.1 < report.rms_before_px


@pytest.mark.slow
@pytest.mark.parametrize("strength", [-0.4, 0.3])
def test_a_lens_of_another_model(strength: float) -> None:
    """Its centre is where it is, whatever polynomial bends it about that."""
    report = calibrate(drawn(16, polynomial(strength, 0.1, 360.0)), MANIFEST)
    assert report.camera.centre_px == pytest.approx(TRUTH.centre_px, abs=0.5)
    assert report.camera.focal_px == pytest.approx(360.0, rel=0.03)
    assert report.camera.radial == pytest.approx(strength, rel=0.15)
    assert report.rms_px < 0.1 < report.rms_before_px


@pytest.mark.slow
def test_frames_of_twice_the_size() -> None:
    """They are halved to find the dots; the centre must not move by half a pixel."""
    lens = division(-8e-7)
    frames = drawn(10, lens, size=(376, 240), focal=720.0, centre=(192.0, 116.0), mm_per_px=0.023)
    report = calibrate(frames, MANIFEST)
    assert report.camera.centre_px == pytest.approx((192.0, 116.0), abs=0.3)
    assert report.camera.radial_px == pytest.approx(-8e-7, rel=0.05)
    assert report.camera.focal_px == pytest.approx(720.0, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("corner", [-0.2, 0.1])
def test_a_strong_lens(corner: float) -> None:
    """With the lens known, frames and dots at the rim are told that were not before."""
    k = corner / ((SIZE[0] / 2) ** 2 + (SIZE[1] / 2) ** 2)
    report = calibrate(drawn(12, division(k)), MANIFEST)
    assert report.camera.centre_px == pytest.approx(TRUTH.centre_px, abs=0.2)
    assert report.camera.radial_px == pytest.approx(k, rel=0.02)
    assert report.camera.focal_px == pytest.approx(360.0, rel=0.02)
    assert report.rms_px < 0.1
    assert report.used == 12


def test_poses_are_of_the_centre_that_is_calibrated(
    upright: simulate.SimulatedSession, upright_report: CameraReport
) -> None:
    report = upright_report

    def rms_mm(camera: Camera | None) -> float:
        solution = solve([upright.frames], MANIFEST, SolveOptions(camera=camera))
        (track,) = solution.trajectories
        assert len(track) == len(upright.truth)
        away = track.position[:, :2] - upright.truth.position[:, :2]
        return 1e3 * float(np.sqrt(np.mean((away**2).sum(axis=1))))

    # The middle of the frame lies 2.7 and 2.4 px from its centre, of 0.046 mm each.
    assert rms_mm(None) == pytest.approx(0.046 * math.hypot(2.7, 2.4), rel=0.1)
    assert rms_mm(report.camera) < 0.005
    assert rms_mm(report.camera) == pytest.approx(rms_mm(TRUTH), abs=0.002)


# ---- what the frames do not tell


def test_untilted_frames_determine_the_lens_but_not_the_focal_length(
    upright_report: CameraReport,
) -> None:
    report = upright_report
    check_lens(report)
    assert (report.focal_from, report.centre_from) == ("usual", "frames")
    assert math.isnan(report.sigma_focal_px)
    assert math.isnan(report.largest_tilt_rad)
    (note,) = report.notes
    assert "do not tell the focal length: they are not tilted enough" in note
    # An answer for another camera's frame is as usual as its frame is large.
    assert report.camera.focal_px == pytest.approx(
        calibration.USUAL_FOCAL_DIAGONALS * math.hypot(*SIZE)
    )


@pytest.mark.slow
def test_a_focal_length_that_is_given_is_kept(
    upright: simulate.SimulatedSession, tilted: simulate.SimulatedSession
) -> None:
    for session in (upright, tilted):
        report = calibrate(session.frames, MANIFEST, CalibrateOptions(focal_px=400.0))
        check_lens(report)  # k in px^-2 does not depend on it
        assert report.camera.focal_px == 400.0
        assert report.camera.radial == pytest.approx(TRUTH.radial_px * 400**2, rel=0.02)
        assert report.focal_from == "given"
        assert len(report.notes) == (session is tilted)
    reported = re.search(r"tell a focal length of ([\d.]+) px", report.notes[0])
    assert reported is not None
    assert float(reported[1]) == pytest.approx(TRUTH.focal_px, rel=0.01)
    agreed = calibrate(tilted.frames, MANIFEST, CalibrateOptions(focal_px=TRUTH.focal_px))
    assert agreed.notes == ()


@pytest.mark.slow
def test_a_prior_focal_length_is_kept_if_it_is_not_observable(
    upright: simulate.SimulatedSession, tilted: simulate.SimulatedSession
) -> None:
    earlier = CalibrateOptions(camera=Camera(SIZE, 333.0, (90.0, 60.0), -0.2))
    report = calibrate(upright.frames, MANIFEST, earlier)
    check_lens(report)
    assert (report.camera.focal_px, report.focal_from) == (333.0, "camera")
    assert "the earlier one is kept, 333.0 px" in report.notes[0]
    report = calibrate(tilted.frames, MANIFEST, earlier)
    assert report.focal_from == "frames"
    assert report.camera.focal_px == pytest.approx(TRUTH.focal_px, rel=0.01)
    of_another = CalibrateOptions(camera=Camera((640, 480), 900.0, (319.5, 239.5)))
    assert calibrate(upright.frames, MANIFEST, of_another).focal_from == "usual"


@pytest.mark.slow
def test_without_bend_and_tilt_the_centre_is_the_middle() -> None:
    straight = Camera(SIZE, 360.0, TRUTH.centre_px)
    report = calibrate(simulated(15, straight).frames, MANIFEST)
    assert report.camera.centre_px == (93.5, 59.5)
    assert report.centre_from == "middle"
    assert all(math.isnan(sigma) for sigma in report.sigma_centre_px)
    assert abs(report.distortion) < 3e-4
    assert any("do not tell the centre" in note for note in report.notes)


@pytest.mark.slow
def test_an_unmeasured_scale_is_reported_and_harmless() -> None:
    session = simulated(16, printer_scale=(1.003, 0.999), tilt_rad=math.radians(10))
    report = calibrate(session.frames, MANIFEST)
    check_lens(report)
    assert report.camera.focal_px == pytest.approx(TRUTH.focal_px, rel=0.01)
    assert report.aspect == pytest.approx(0.004, abs=3e-4)
    assert "0.40 % longer along x" in report.notes[0]
    measured = calibrate(session.frames, replace(MANIFEST, scale=(1.003, 0.999)))
    assert measured.aspect == pytest.approx(0, abs=3e-4)
    assert measured.notes == ()
    assert measured.camera.focal_px == pytest.approx(report.camera.focal_px, rel=0.002)


@pytest.mark.slow
def test_dots_have_the_positions_of_the_manifest() -> None:
    shifted = replace(MANIFEST, offset_mm=0.060)
    options = SimulationOptions(frames=10, path="random", camera=TRUTH)
    frames = simulate.simulate(shifted, options).frames
    frames = replace(frames, images=list(frames.images))
    assert calibrate(frames, shifted).rms_px < 0.03
    assert calibrate(frames, MANIFEST).rms_px > 0.2


@pytest.mark.slow
def test_a_rolling_shutter_is_no_tilt() -> None:
    report = calibrate(drawn(14, division(TRUTH.radial_px), skew=0.02), MANIFEST)
    assert report.focal_from == "usual"
    assert "the shutter may be a rolling one" in report.notes[0]
    assert report.rms_px < 0.1


# ---- which frames


class Some(Sequence[Image]):
    """Images, some of which cannot be read."""

    def __init__(self, images: Sequence[Image], broken: set[int]) -> None:
        self.images, self.broken = images, broken

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> Image:  # type: ignore[override]
        if index in self.broken:
            raise InputError("the message is damaged")
        return self.images[index]

    def __iter__(self) -> Iterator[Image]:
        return (self[k] for k in range(len(self)))


@pytest.mark.slow
def test_frames_that_cannot_be_used_are_counted(tilted: simulate.SimulatedSession) -> None:
    good = list(tilted.frames.images)
    blank = np.full((120, 188), 200, np.uint8)
    noise = np.random.default_rng(0).integers(0, 256, (120, 188), np.uint8)
    larger = cv2.copyMakeBorder(good[3], 4, 4, 6, 6, cv2.BORDER_REFLECT)
    images = [blank, *good[:10], noise, larger, *good[10:], blank, good[0]]
    report = calibrate(replace(as_frames(images), images=Some(images, {5, 20})), MANIFEST)
    check_lens(report)
    assert report.skipped == {
        "no_pattern": 3,
        "not_of_the_cameras_size": 1,
        "unreadable_frame": 2,
    }
    assert (report.seen, report.located, report.used) == (30, 24, 24)


def test_too_few_frames(tilted: simulate.SimulatedSession) -> None:
    blank = [np.full((120, 188), 200, np.uint8)] * 6
    with pytest.raises(DegenerateError, match="none of 6 frames show the pattern") as error:
        calibrate(as_frames(blank), MANIFEST)
    assert error.value.hint is not None
    images = [*tilted.frames.images[:4], *blank]
    with pytest.raises(DegenerateError, match=r"4 of 10 frames show .* where 5 are needed"):
        calibrate(as_frames(images), MANIFEST)
    assert calibrate(as_frames(tilted.frames.images[:5]), MANIFEST).used == 5


def test_frames_of_another_sheet(tilted: simulate.SimulatedSession) -> None:
    other = replace(MANIFEST.sheets[0], origin=(1000, 1000))
    with pytest.raises(DegenerateError, match=r"25 of 25 frames .* off all sheets") as error:
        calibrate(tilted.frames, replace(MANIFEST, sheets=(other,)))
    assert "manifest" in str(error.value.hint)
    with pytest.raises(DegenerateError, match="none of 25 frames"):
        calibrate(tilted.frames, replace(MANIFEST, codec="microdots"))


@pytest.mark.parametrize("focal_px", [0.0, -5.0, math.inf, math.nan])
def test_an_impossible_focal_length(tilted: simulate.SimulatedSession, focal_px: float) -> None:
    with pytest.raises(InputError, match="focal length"):
        calibrate(tilted.frames, MANIFEST, CalibrateOptions(focal_px=focal_px))


def test_a_lens_that_no_camera_has_is_refused(
    tilted: simulate.SimulatedSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is returned that `locatk solve` could not take as a camera."""
    monkeypatch.setattr(calibration, "MAX_CORNER_DISTORTION", 0.01)
    with pytest.raises(DegenerateError, match="no lens of this kind"):
        calibrate(tilted.frames, MANIFEST)


def test_of_long_sessions_some_frames_are_taken(
    tilted: simulate.SimulatedSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (camera_views, calibration):
        monkeypatch.setattr(module, "MAX_FITTED_FRAMES", 8)
    monkeypatch.setattr(camera_views, "MAX_LOCALIZED_FRAMES", 16)
    monkeypatch.setattr(camera_views, "FRAMES_PER_BLOCK", 8)
    taken: list[int] = []

    class Counted(Some):
        def __getitem__(self, index: int) -> Image:  # type: ignore[override]
            taken.append(index)
            return super().__getitem__(index % 25)

        def __len__(self) -> int:
            return 10_000

    images = Counted(list(tilted.frames.images), set())
    time_ns = np.arange(10_000)
    frames = Frames("camera", time_ns, tuple(map(str, time_ns)), images)
    report = calibrate(frames, MANIFEST)
    assert (report.seen, report.located, report.used) == (16, 16, 8)
    assert len(taken) == 24
    assert np.diff([0, *sorted(taken[:16]), 10_000]).max() < 2 * 10_000 / 16
    check_lens(report)


def test_any_beginning_of_the_order_is_spread() -> None:
    for count in (1, 7, 1000):
        assert sorted(spread_order(count)) == list(range(count))
    for some in (5, 20, 100):
        gaps = np.diff([0, *sorted(spread_order(1000)[:some]), 1000])
        assert gaps.max() < 3 * 1000 / some
    assert spread_order(0) == []


def test_rare_tilted_or_rotated_frames_are_selected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(camera_views, "MAX_FITTED_FRAMES", 20)
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(-8, 9), np.arange(-6, 7)), axis=-1).reshape(-1, 2) * 1.0
    result = []
    for k in range(120):
        c, s = (f(2.0 if k == 37 else rng.normal(0, 0.02)) for f in (math.cos, math.sin))
        towards = [2e-3, 0] if k == 71 else rng.normal(0, 1e-5, 2)
        rotated = 11.0 * grid @ np.array([[c, s], [-s, c]])
        pixels = rotated / (1 + rotated @ towards)[:, None] + [93.5, 59.5]
        result.append(CalibrationFrame(k, SIZE, pixels, grid))
    chosen = [observed.index for observed in select_diverse_frames(SIZE, result, 120)]
    assert len(set(chosen)) == 20
    assert {37, 71} < set(chosen)
    assert np.diff([0, *chosen, 120]).max() < 30
    assert select_diverse_frames(SIZE, result[:15], 120) == result[:15]


@pytest.mark.slow
def test_the_same_frames_give_the_same_camera(upright: simulate.SimulatedSession) -> None:
    first, second = (calibrate(upright.frames, MANIFEST).camera for _ in range(2))
    assert first == second
