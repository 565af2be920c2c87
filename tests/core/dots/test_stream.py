"""Live poses on dots: frame by frame, as the offline solver has them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.dots import stream as stream_module
from locatk.core.dots.camera import Camera
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import localize_frames
from locatk.core.dots.results import DotDetection
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.dots.simulation.session import SimulationOptions, simulate
from locatk.core.dots.solver import SolveOptions, solve
from locatk.core.dots.stream import DotsStream
from locatk.core.errors import InputError
from locatk.core.streaming.events import (
    DetectionEvent,
    Fix,
    PoseEstimate,
    StateChange,
    Stream,
    StreamEvent,
    TrackingState,
    WarningEvent,
)
from locatk.core.streaming.localizer import LiveLocalizer

Image = NDArray[np.uint8]
Shoot = Callable[..., Image]

SHEET = Sheet("s", (1000, 2000), (200, 200), (0, 0), (120.0, 120.0), (8.0, 8.0))
MANIFEST = Manifest((SHEET,))
CAMERA = Camera((188, 120), 348.7, (93.5, 59.5))
BLANK = np.full((120, 188), 200, np.uint8)


def frames_of(
    images: Sequence[Image], device: str = "robot", start_s: float = 100.0, step_s: float = 0.01
) -> Frames:
    time_ns = np.rint(1e9 * (start_s + step_s * np.arange(len(images)))).astype(np.int64)
    return Frames(device, time_ns, tuple(f"{device}{k}" for k in range(len(images))), images)


def cut(frames: Frames, first: int, last: int) -> Frames:
    part = slice(first, last)
    return Frames(frames.device, frames.time_ns[part], frames.names[part], frames.images[part])


def of_type(events: Sequence[StreamEvent], kind: type) -> list[Any]:
    return [event for event in events if isinstance(event, kind)]


def codes(events: Sequence[StreamEvent]) -> list[str]:
    return [event.warning.code for event in of_type(events, WarningEvent)]


def fingerprint(events: Sequence[StreamEvent]) -> list[Any]:
    return [
        tuple(
            value.tobytes() if isinstance(value, np.ndarray) else repr(value)
            for value in (getattr(event, name) for name in event.__dataclass_fields__)
        )
        for event in events
    ]


@pytest.fixture(scope="module")
def mixed() -> Frames:
    """Frames with poses, mirrored ones, an inverted one and one without a pattern."""
    options = SimulationOptions(frames=9, path="random", dust=0.02, missing=0.02)
    simulated = simulate(None, options)
    images = [simulated.frames.images[k] for k in range(9)]
    images += [images[0][:, ::-1], 255 - images[1], BLANK, images[3][:, ::-1], images[2]]
    return frames_of(images)


def simulated_manifest() -> Manifest:
    return simulate(None, SimulationOptions(frames=1)).manifest


# --- the same poses as offline


def test_fixes_equal_the_offline_solution(mixed: Frames) -> None:
    manifest = simulated_manifest()
    offline = solve([mixed], manifest)
    (track,) = offline.trajectories
    events = DotsStream(manifest).push(mixed)
    fixes = of_type(events, Fix)
    assert [fix.time_ns for fix in fixes] == track.time_ns.tolist()
    assert len(fixes) == 10
    for name in ("position", "quaternion", "covariance"):
        live = np.array([getattr(fix, name) for fix in fixes])
        np.testing.assert_allclose(live, getattr(track, name), rtol=1e-9, atol=1e-12)
    detections = [event.detection for event in of_type(events, DetectionEvent)]
    assert all(isinstance(each, DotDetection) for each in detections)
    assert [each.frame for each in detections] == [each.frame for each in offline.detections]
    np.testing.assert_allclose(
        [each.confidence for each in detections],
        [each.confidence for each in offline.detections],  # type: ignore[attr-defined]
        atol=1e-9,
    )
    assert {fix.frame for fix in fixes} == {track.frame}


def test_a_frame_has_the_pose_of_a_recording_of_it(mixed: Frames) -> None:
    manifest = simulated_manifest()
    events = DotsStream(manifest, SolveOptions(camera=CAMERA)).push(mixed)
    for index, fix in zip([*range(9), 13], of_type(events, Fix), strict=True):
        alone = solve([cut(mixed, index, index + 1)], manifest, SolveOptions(camera=CAMERA))
        (track,) = alone.trajectories
        assert fix.position.tobytes() == track.position[0].tobytes()
        assert fix.covariance.tobytes() == track.covariance[0].tobytes()
        assert fix.quaternion.tobytes() == track.quaternion[0].tobytes()


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(cuts=st.sets(st.integers(1, 13)))
def test_any_pieces_give_the_same_events(cuts: set[int]) -> None:
    frames, manifest = _mixed_frames(), simulated_manifest()
    stream = DotsStream(manifest)
    events: list[StreamEvent] = []
    for first, last in itertools.pairwise(sorted({0, *cuts, len(frames)})):
        events += stream.push(cut(frames, first, last))
    assert fingerprint(events) == fingerprint(DotsStream(manifest).push(frames))


_CACHE: list[Frames] = []


def _mixed_frames() -> Frames:
    if not _CACHE:
        simulated = simulate(None, SimulationOptions(frames=5, path="random"))
        images = [simulated.frames.images[k] for k in range(5)]
        others = [images[0][:, ::-1], 255 - images[1], BLANK, images[3][:, ::-1]]
        _CACHE.append(frames_of([*images, *others, *images]))
    return _CACHE[0]


@pytest.mark.slow
def test_covariances_fit_the_errors() -> None:
    """Through the filter of the localizer, which passes fixes unchanged without odometry."""
    options = SimulationOptions(frames=60, path="random", noise=4.0, jitter_m=10e-6, seed=3)
    simulated = simulate(None, options)
    localizer = LiveLocalizer(DotsStream(simulated.manifest, SolveOptions(camera=simulated.camera)))
    poses = of_type(localizer.push(simulated.frames), PoseEstimate)  # type: ignore[arg-type]
    index = np.searchsorted(simulated.truth.time_ns, [pose.time_ns for pose in poses])
    error = np.array([pose.position[:2] for pose in poses]) - simulated.truth.position[index, :2]
    covariance = np.array([pose.covariance[:2, :2] for pose in poses])
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    assert len(poses) >= 55
    assert 0.5 < nees.mean() / 2 < 1.6


# --- sheets and cameras


def test_is_a_stream() -> None:
    stream: Stream = DotsStream(MANIFEST)
    assert stream.system == "dots"
    assert not stream.advance(1)
    assert not stream.finish()
    assert stream.background_task() is None
    assert not stream.push("odometry")


def test_sheets_are_frames_of_their_own(shoot: Shoot) -> None:
    other = replace(SHEET, id="t", origin=(5000, 2000))
    images = [shoot(at=(1060.0, 2100.0)), shoot(at=(5060.0, 2100.0))]
    events = DotsStream(Manifest((SHEET, other))).push(frames_of(images))
    assert [fix.frame for fix in of_type(events, Fix)] == ["s", "t"]
    assert all(fix.probability >= 0.999 for fix in of_type(events, Fix))
    assert all(fix.common_covariance is None for fix in of_type(events, Fix))


def test_errors_of_the_floor_are_common(shoot: Shoot) -> None:
    tile = replace(
        SHEET,
        position_mm=(100.0, 50.0),
        covariance_mm_deg=((0.04, 0.0, 0.0), (0.0, 0.04, 0.0), (0.0, 0.0, 0.01)),
        distortion_sigma_mm=(0.1, 0.1),
    )
    manifest = Manifest((tile,))
    (fix,) = of_type(DotsStream(manifest).push(frames_of([shoot(at=(1060.0, 2100.0))])), Fix)
    assert fix.frame == "floor"
    assert fix.common_covariance is not None
    plane = np.ix_([0, 1, 5], [0, 1, 5])
    common = fix.common_covariance[plane]
    np.testing.assert_allclose(common, manifest.covariance(0, fix.position[:2]))
    assert np.linalg.eigvalsh(fix.covariance[plane] - common).min() > 0
    assert np.isnan(fix.common_covariance[2]).all()


def test_cameras_are_independent(shoot: Shoot) -> None:
    """A rejected frame of one camera does not change the reports of another."""
    stream = DotsStream(MANIFEST)
    good = shoot(at=(1060.0, 2100.0))
    events = [*stream.push(frames_of([BLANK], "left")), *stream.push(frames_of([good], "right"))]
    events += stream.push(frames_of([BLANK], "left", start_s=101))
    (change,) = of_type(events, StateChange)
    assert (change.device, change.state, change.reason) == (
        "left",
        TrackingState.LOST,
        "too_few_dots",
    )
    assert codes(events) == ["no_camera_model", "no_camera_model"]


@pytest.mark.slow
def test_frames_across_a_seam(
    laid_sheet: Callable[..., Any], shoot_floor: Callable[..., Any]
) -> None:
    """The same poses as offline, which separates the sheets."""
    size, page, first, step = (370, 540), (210.0, 297.0), (10.0, 12.0), 360 * 0.508
    border = first[0] + 364.5 * 0.508
    tiles = Manifest(
        (
            Sheet("left", (1000, 2000), size, (0, 0), page, first, (0.0, 0.0)),
            Sheet("right", (1360, 2000), size, (0, 0), page, first, (step, 0.0)),
        )
    )
    left = laid_sheet((1000, 2000), size, page, first, visible=(0.0, 0.0, border, page[1]))
    visible = (border - step, 0.0, page[0], page[1])
    right = laid_sheet((1360, 2000), size, page, first, step + 0.9, 1.0, -0.3, visible=visible)
    images = [
        shoot_floor((left, right), border + 0.5 * (k - 3), 100.0 + 7 * k, heading=0.4 * k, seed=k)
        for k in range(7)
    ]
    frames, options = frames_of(images), SolveOptions(camera=CAMERA)
    offline = solve([frames], tiles, options)
    fixes = of_type(DotsStream(tiles, options).push(frames), Fix)
    (track,) = offline.trajectories
    assert len(fixes) == len(track) >= 4
    np.testing.assert_allclose([fix.position for fix in fixes], track.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose([fix.covariance for fix in fixes], track.covariance, rtol=1e-9)


# --- rejected frames


def test_reasons_are_reported_when_they_change(shoot: Shoot) -> None:
    good, off = shoot(at=(1060.0, 2100.0)), shoot(at=(3060.0, 2100.0))
    images = [BLANK, BLANK, good, BLANK, off, off, good, good]
    stream = DotsStream(MANIFEST)
    events = stream.push(frames_of(images))
    changes = [(change.time_ns, change.reason) for change in of_type(events, StateChange)]
    time_ns = frames_of(images).time_ns.tolist()
    assert changes == [
        (time_ns[0], "too_few_dots"),
        (time_ns[3], "too_few_dots"),
        (time_ns[4], "off_sheet"),
    ]
    assert stream.rejected == {"off_sheet": 2, "too_few_dots": 3}
    assert len(of_type(events, Fix)) == 3
    assert codes(events) == ["no_camera_model", "frames_off_sheet"]


def test_unreadable_frames_and_other_sizes(shoot: Shoot) -> None:
    class Damaged(list[Image]):
        def __getitem__(self, index: Any) -> Any:
            if index == 1:
                raise InputError("frame 1 cannot be read")
            return super().__getitem__(index)

    images = Damaged([shoot(at=(1060.0, 2100.0)), BLANK, BLANK[:60]])
    stream = DotsStream(MANIFEST, SolveOptions(camera=CAMERA))
    events = stream.push(frames_of(images))
    assert [change.reason for change in of_type(events, StateChange)] == [
        "unreadable_frame",
        "not_of_the_cameras_size",
    ]
    assert len(of_type(events, Fix)) == 1


ALTERED = {
    "mirrored": lambda image: image[:, ::-1],
    "inverted": lambda image: 255 - image,
    "mirrored_and_inverted": lambda image: 255 - image[:, ::-1],
}


@pytest.mark.slow
@pytest.mark.parametrize("reason", ALTERED)
def test_mirrored_and_inverted_frames_are_named(shoot: Shoot, reason: str) -> None:
    """Within a second at 100 frames/s, once; frames as printed end it."""
    images = [shoot(at=(1050.0 + k, 2100.0), heading=k, seed=k) for k in range(3)]
    altered = [ALTERED[reason](images[k % 3]) for k in range(100)]
    stream = DotsStream(MANIFEST)
    events = stream.push(frames_of(altered))
    assert codes(events) == ["no_camera_model", f"{reason}_frames"]
    assert of_type(events, StateChange)[-1].reason == reason
    assert not of_type(events, Fix)
    events = stream.push(frames_of(images, start_s=200))
    assert len(of_type(events, Fix)) == 3
    (change,) = of_type(stream.push(frames_of([BLANK], start_s=300)), StateChange)
    assert change.reason == "too_few_dots"


@pytest.mark.slow
@pytest.mark.parametrize(("right", "printed"), [(0, True), (40, False)])
def test_frames_of_another_codec_are_named(shoot: Shoot, right: int, printed: bool) -> None:
    good = [shoot(at=(1050.0 + 11 * k, 2100.0), seed=k) for k in range(2)]
    other = [shoot(at=(1050.0 + 11 * k, 2100.0), codec="microdots", seed=k) for k in range(4)]
    images = [*(good[k % 2] for k in range(right)), *(other[k % 4] for k in range(20))]
    events = DotsStream(MANIFEST).push(frames_of(images, step_s=0.1))
    (warning,) = (e.warning for e in of_type(events, WarningEvent) if "codec" in e.warning.code)
    assert warning.code == "other_codec"
    assert "'microdots'" in warning.message
    assert ("were printed with" in warning.message) == printed


def test_causes_are_searched_in_few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """One more localization per 0.1 s."""
    tried = []

    def count(images: Image, *args: Any, **options: Any) -> Any:
        tried.append(len(images))
        return localize_frames(images, *args, **options)

    monkeypatch.setattr(stream_module, "localize_frames", count)
    noise = np.random.default_rng(4).integers(0, 256, (40, 60, 60)).astype(np.uint8)
    DotsStream(MANIFEST).push(frames_of(list(noise), step_s=0.01))
    assert 3 <= sum(tried) <= 4


def test_the_published_method_is_refused() -> None:
    with pytest.raises(InputError, match="no method 'paper'"):
        DotsStream(MANIFEST, SolveOptions(method="paper"))


def test_state_does_not_grow() -> None:
    """A million rejected frames are counters, not lists."""
    stream = DotsStream(MANIFEST)
    stream.push(frames_of([BLANK] * 20))
    (state,) = stream._cameras.values()
    before = {name: getattr(state, name) for name in state.__dataclass_fields__}
    stream.push(frames_of([BLANK] * 200, start_s=200))
    after = {name: getattr(state, name) for name in state.__dataclass_fields__}
    for name, value in before.items():
        if not isinstance(value, int | str):
            assert len(after[name]) == len(value)
