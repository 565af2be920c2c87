"""Frames to places: the issue's table of conditions, on frames of another renderer.

Every frame stands alone, at a random place of the whole range, section and heading; the
thresholds are those of the issue.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import MAIN_SEQUENCE_LENGTH, SECTION_LENGTH, codec
from locatk.core.dots.detection.lattice import DotLattices
from locatk.core.dots.identification.soft_bits import soft_bits
from locatk.core.dots.localization import frames as localization
from locatk.core.dots.localization.frames import (
    LocalizedFrames,
    unlocalized_frames,
)
from locatk.core.errors import InputError

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Shots = Callable[..., Any]

localize_frames = functools.partial(localization.localize_frames, other_codec_odds=0)
dot_correspondences = functools.partial(localization.dot_correspondences, other_codec_odds=0)
"""The codec is certain: frames of a known sheet."""

CORNER_SQUARE = 93.5**2 + 59.5**2
TILT_10 = math.radians(10)


@dataclass(frozen=True)
class Outcome:
    """What became of frames: fates by name, errors (n, 3) of the right ones, their NEES."""

    fate: Counter[str]
    error: Array
    nees: Array

    @property
    def rms(self) -> float:
        """Of x and y, in pitches."""
        return float(np.sqrt(np.mean(self.error[:, :2] ** 2)))


def judge(actual: LocalizedFrames, shots: list[Any]) -> Outcome:
    fate: Counter[str] = Counter()
    errors, nees = [], []
    for k, one in enumerate(shots):
        if actual.rejected[k]:
            fate[actual.rejected[k]] += 1
            continue
        error = np.array(
            [*(actual.grid[k] - one.at), math.remainder(actual.heading[k] - one.heading, math.tau)]
        )
        right = np.hypot(*error[:2]) < 0.5 and abs(error[2]) < 0.1
        if not right or tuple(actual.section[k]) != one.section:
            fate["wrong"] += 1
            continue
        fate["right"] += 1
        errors.append(error)
        nees.append(error @ np.linalg.solve(actual.covariance[k], error) / 3)
    return Outcome(fate, np.array(errors).reshape(-1, 3), np.array(nees))


def shots_of(shot: Shots, count: int, seed: int, **how: Any) -> list[Any]:
    """Shots at random places and headings; what is callable in ``how`` draws its value."""
    rng = np.random.default_rng(seed)
    return [
        shot(
            at=tuple(rng.uniform(100, SECTION_LENGTH - 100, 2)),
            heading=rng.uniform(-math.pi, math.pi),
            section=tuple(rng.integers(0, MAIN_SEQUENCE_LENGTH, 2).tolist()),
            towards=rng.uniform(0, math.tau),
            seed=seed * 1000 + k,
            **{name: value(rng) if callable(value) else value for name, value in how.items()},
        )
        for k in range(count)
    ]


def study(
    shot: Shots,
    count: int,
    seed: int,
    *,
    camera: Camera | None = None,
    spoil: Callable[[Image, np.random.Generator], Image] = lambda image, rng: image,
    **how: Any,
) -> Outcome:
    shots = shots_of(shot, count, seed, **how)
    rng = np.random.default_rng(seed)
    images = np.stack([spoil(one.take(), rng) for one in shots])
    return judge(localize_frames(images, codec(shots[0].codec), camera), shots)


# --- the table


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "least", "rms"),
    [
        ({"dot": 0.25}, 24, 0.003),
        ({"dot": 0.30}, 24, 0.003),
        ({"dot": 0.35}, 24, 0.003),
        ({"dot": 1 / 6}, 24, 0.003),
        ({"missing": 0.02}, 24, 0.003),
        ({"missing": 0.05}, 24, 0.003),
        ({"missing": 0.10}, 24, 0.003),
        ({"blur": 2.2}, 24, 0.005),
        ({"vignette": 0.4, "noise": 16.0}, 24, 0.003),
        ({"tilt": lambda rng: rng.uniform(0, TILT_10)}, 24, 0.003),
        ({"tilt": TILT_10, "radial": -0.045 / CORNER_SQUARE}, 24, 0.003),
        ({"dust": 0.03, "jitter": 0.02, "motion": 2.0, "gradient": 0.2}, 24, 0.01),
    ],
    ids=["dot 0.25", "dot 0.30", "dot 0.35", "dot 1/6", "missing 2 %", "missing 5 %",
         "missing 10 %", "blur", "vignette and noise", "tilt", "tilt and lens", "all kinds"],
)  # fmt: skip
def test_conditions(shot: Shots, how: dict[str, Any], least: int, rms: float) -> None:
    outcome = study(shot, 24, len(how) + 10, **how)
    assert outcome.fate["right"] >= least, outcome.fate
    assert outcome.rms <= rms
    # No systematic error: half a pixel would be 0.045 pitches.
    assert np.abs(outcome.error[:, :2].mean(axis=0)).max() < rms
    assert np.degrees(np.abs(outcome.error[:, 2])).max() < 0.2


@pytest.mark.parametrize("name", ["libdots", "microdots"])
def test_other_codecs(shot: Shots, name: str) -> None:
    assert study(shot, 10, 2, codec=name).fate == {"right": 10}


@pytest.mark.parametrize("lean", [0.0, TILT_10])
def test_a_known_camera(shot: Shots, lean: float) -> None:
    # Off centre, and with twice the distortion of the paper's lens.
    camera = Camera((188, 120), 300.0, (97.3, 55.1), -0.1 * 300.0**2 / CORNER_SQUARE)
    outcome = study(
        shot, 16, 3, camera=camera, centre=camera.centre_px, focal=camera.focal_px,
        radial=camera.radial_px, tilt=lean,
    )  # fmt: skip
    assert outcome.fate == {"right": 16}
    assert outcome.rms < 0.003


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "pitch", "count"),
    [
        ((188, 120), 8.0, 10),
        ((188, 120), 16.0, 10),
        ((120, 120), 11.0, 10),
        ((320, 240), 11.0, 6),
        ((320, 240), 20.0, 6),
        ((640, 480), 11.0, 3),
        ((640, 480), 20.0, 3),
        ((640, 480), 40.0, 3),
        ((1280, 960), 20.0, 2),
        ((1280, 960), 40.0, 2),
    ],
)
def test_other_cameras(shot: Shots, size: tuple[int, int], pitch: float, count: int) -> None:
    outcome = study(shot, count, 4, size=size, pitch=pitch, focal=1.85 * size[0])
    assert outcome.fate == {"right": count}
    assert outcome.rms < 0.003


@pytest.mark.slow
def test_errors_agree_with_the_covariance(shot: Shots) -> None:
    for how in ({}, {"noise": 12.0}, {"dot": 1 / 6, "tilt": TILT_10}, {"jitter": 0.02}):
        shots = shots_of(shot, 25, 5, **how)
        actual = localize_frames(np.stack([one.take() for one in shots]), codec("anoto"))
        outcome = judge(actual, shots)
        assert outcome.fate == {"right": 25}
        assert 0.5 < outcome.nees.mean() < 2
        # Each of x, y and heading by itself too.
        sigma = np.sqrt(np.einsum("nii->ni", actual.covariance))
        each = np.mean((outcome.error / sigma) ** 2, axis=0)
        assert (each > 0.4).all()
        assert (each < 2.5).all()


# --- each frame stands alone


@pytest.mark.slow
def test_a_frames_answer_does_not_depend_on_its_company(shot: Shots) -> None:
    hows: list[dict[str, Any]] = [
        {},
        {"rim": -5.0},
        {"pitch": 7.0},
        {"missing": 0.75},
        {"noise": 90.0},
    ]
    shots = [one for k, how in enumerate(hows) for one in shots_of(shot, 4, k, **how)]
    images = np.stack([one.take() for one in shots])
    together = localize_frames(images, codec("anoto"))
    assert 10 <= together.accepted.sum() < 20
    order = np.random.default_rng(6).permutation(len(images))
    shuffled = localize_frames(images[order], codec("anoto"))
    alone = [localize_frames(image[None], codec("anoto")) for image in images]
    for k in range(len(images)):
        for other in (alone[k], locate_row(shuffled, int(np.flatnonzero(order == k)[0]))):
            assert other.rejected[0] == together.rejected[k]
            if together.accepted[k]:
                for field in fields(LocalizedFrames):
                    if field.name != "rejected":
                        np.testing.assert_allclose(
                            getattr(other, field.name)[0],
                            getattr(together, field.name)[k],
                            rtol=1e-6,
                            atol=1e-6,
                        )


def locate_row(actual: LocalizedFrames, k: int) -> LocalizedFrames:
    return LocalizedFrames(
        **{f.name: getattr(actual, f.name)[k : k + 1] for f in fields(LocalizedFrames)}
    )


def test_frames_rotated_by_90_degrees(shot: Shots) -> None:
    (one,) = shots_of(shot, 1, 7)
    image = one.take()
    upright = localize_frames(image[None], codec("anoto"))
    for quarters in (1, 2, 3):
        # The page seems turned counter-clockwise: the camera was turned clockwise.
        rotated = np.ascontiguousarray(np.rot90(image, quarters))
        actual = localize_frames(rotated[None], codec("anoto"))
        assert actual.accepted[0]
        np.testing.assert_allclose(actual.grid, upright.grid, atol=2e-3)
        change = actual.heading[0] - upright.heading[0] + quarters * math.pi / 2
        assert math.remainder(change, math.tau) == pytest.approx(0, abs=2e-3)


def test_light_and_contrast_do_not_matter(shot: Shots) -> None:
    shots = shots_of(shot, 6, 8)
    images = np.stack([one.take() for one in shots]).astype(float)
    for change in (images * 0.1, images * 0.3, images * 1.4, 130 + (images - 130) * 0.12):
        outcome = judge(
            localize_frames(np.clip(np.rint(change), 0, 255).astype(np.uint8), codec("anoto")),
            shots,
        )
        assert outcome.fate == {"right": 6}


# --- frames that show the pattern only in part


def textured(image: Image, rng: np.random.Generator, share: float) -> Image:
    """A hand over this share of the frame, from any side."""
    covered = side(image, rng, share)
    skin = 90 + 40 * cv2.GaussianBlur(rng.normal(0, 1, image.shape), (0, 0), 6)
    skin += 12 * cv2.GaussianBlur(rng.normal(0, 1, image.shape), (0, 0), 1.2)
    return np.where(covered, np.clip(skin, 0, 255), image).astype(np.uint8)


def bare(image: Image, rng: np.random.Generator, share: float) -> Image:
    """Paper without dots over this share of the frame, from any side."""
    paper = np.clip(205 + rng.normal(0, 3, image.shape), 0, 255)
    return np.where(side(image, rng, share), paper, image).astype(np.uint8)


def side(image: Image, rng: np.random.Generator, share: float) -> NDArray[np.bool_]:
    height, width = image.shape
    y, x = np.mgrid[:height, :width].astype(float)
    angle = rng.uniform(0, math.tau)
    along = (x - (width - 1) / 2) * math.cos(angle) + (y - (height - 1) / 2) * math.sin(angle)
    hidden: NDArray[np.bool_] = along > np.quantile(along, 1 - share)
    return hidden


@pytest.mark.slow
@pytest.mark.parametrize("cover", [textured, bare])
@pytest.mark.parametrize(("share", "least"), [(0.25, 19), (0.5, 13), (0.65, 0), (0.75, 0)])
def test_frames_that_are_half_covered(
    shot: Shots, cover: Callable[..., Image], share: float, least: int
) -> None:
    outcome = study(shot, 20, 9, spoil=lambda image, rng: cover(image, rng, share))
    assert outcome.fate["wrong"] == 0
    assert outcome.fate["right"] >= least
    assert least == 0 or outcome.rms < 0.02


@pytest.mark.slow
def test_uncertain_frames_are_rejected_with_a_reason(shot: Shots) -> None:
    shots = shots_of(shot, 40, 21)
    rng = np.random.default_rng(21)
    images = np.stack([bare(one.take(), rng, 0.72) for one in shots])
    actual = localize_frames(images, codec("anoto"))
    np.testing.assert_array_equal(actual.accepted, actual.confidence >= 0.999)
    doubtful = (actual.confidence >= 0.5) & ~actual.accepted
    assert doubtful.any()
    assert set(actual.rejected[doubtful]) == {"low_confidence"}
    assert "low_confidence" not in actual.rejected[~doubtful]
    lenient = localize_frames(images, codec("anoto"), min_confidence=0.9)
    assert lenient.accepted.sum() > actual.accepted.sum()
    np.testing.assert_array_equal(lenient.accepted, lenient.confidence >= 0.9)


@pytest.mark.slow
def test_a_strip_of_few_rows_is_not_decoded(shot: Shots) -> None:
    # Rows tell y by the shifts between them; five rows have four, which many places share.
    shots = shots_of(shot, 24, 10)
    shots = [shot(**{**vars_of(one), "heading": 0.0}) for one in shots]
    images = np.stack([one.take() for one in shots])
    for rows in (4, 5, 6):
        strips = images.copy()
        strips[:, round(rows * 11.04) :] = 205
        assert judge(localize_frames(strips, codec("anoto")), shots).fate["wrong"] == 0
    strips = images.copy()
    strips[:, 100:] = 205
    assert judge(localize_frames(strips, codec("anoto")), shots).fate["right"] >= 23


def vars_of(one: Any) -> dict[str, Any]:
    return {f.name: getattr(one, f.name) for f in fields(one)}


def test_the_rim_of_a_sheet(shot: Shots) -> None:
    outcome = study(shot, 24, 11, rim=3.0)
    assert outcome.fate == {"right": 24}


@pytest.mark.parametrize("at", [(4.3, 700.2), (700.2, 4.3), (4.6, 4.1)])
def test_the_first_positions_of_the_pattern(shot: Shots, at: tuple[float, float]) -> None:
    # The frame looks past the corner of the plane; the ledger's first sheet lies there.
    shots = [shot(at=at, heading=heading, section=(5, 9)) for heading in (0.4, 2.0, 3.5, 5.1)]
    images = np.stack([one.take() for one in shots])
    assert judge(localize_frames(images, codec("anoto")), shots).fate == {"right": 4}


def test_the_last_positions_of_the_pattern(shot: Shots) -> None:
    (one,) = shots_of(shot, 1, 12)
    last = shot(**{**vars_of(one), "at": (SECTION_LENGTH - 20.0, SECTION_LENGTH - 20.0)})
    assert judge(localize_frames(last.take()[None], codec("anoto")), [last]).fate == {"right": 1}


def test_a_frame_of_two_codecs_gets_no_thorough_fit(
    shot: Shots, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From residue 220 on, the fourth sequences of anoto and libdots differ by a digit."""
    image = shot(at=(241_000_100.0, 241_000_230.0), heading=0.0).take()[None]
    fits: list[dict[str, bool]] = []
    fit_lattices = localization.fit_lattices
    monkeypatch.setattr(
        localization, "fit_lattices", lambda *a, **k: fits.append(k) or fit_lattices(*a, **k)
    )
    actual = localization.localize_frames(image, codec("anoto"))
    assert actual.ambiguous[0]
    assert actual.rejected[0] == "low_confidence"
    assert not any(fit["is_thorough"] for fit in fits)
    certain = localize_frames(image, codec("anoto"))
    assert certain.accepted[0]
    assert not certain.ambiguous[0]
    np.testing.assert_allclose(actual.grid, certain.grid)
    # If most of its dots are not on the lattice, it may be.
    monkeypatch.setattr(localization, "SETTLED_FRACTION", 2.0)
    assert not localization.localize_frames(image, codec("anoto")).ambiguous[0]
    assert any(fit["is_thorough"] for fit in fits)


@pytest.mark.parametrize("beyond", [-4, -2, 0, 2, 4])
def test_a_border_of_sections_is_rejected_with_a_reason(shot: Shots, beyond: int) -> None:
    """Two sections side by side, with ``beyond`` pitches of the second left of the middle."""
    rng = np.random.default_rng(13)
    images = []
    for heading in rng.uniform(-math.pi, math.pi, 4).tolist():
        y = int(rng.integers(1000, SECTION_LENGTH - 1000))
        one = shot(at=(SECTION_LENGTH - 0.5 + beyond, y + 0.0), heading=heading)
        count, first = 2 * one.reach + 1, SECTION_LENGTH - one.corner[0]
        u, v = (tuple(rng.integers(0, MAIN_SEQUENCE_LENGTH, 2).tolist()) for _ in range(2))
        symbols = np.concatenate(
            [
                codec("anoto").symbols((one.corner[0], one.corner[1]), (first, count), u),
                codec("anoto").symbols((0, one.corner[1]), (count - first, count), v),
            ],
            axis=1,
        )
        images.append(shot(**{**vars_of(one), "symbols": symbols}).take())
    actual = localize_frames(np.stack(images), codec("anoto"))
    assert not actual.accepted.any()
    if abs(beyond) == 4:  # enough of one section to know where it ends
        assert set(actual.rejected) <= {"section_border", "no_code", "low_confidence"}
        assert "section_border" in actual.rejected


# --- clean rasters: what `print pattern --format png` makes


@pytest.mark.parametrize(("pixels", "dot"), [(6, 1), (12, 2), (24, 4), (36, 6)])
def test_the_printers_raster_itself(pixels: int, dot: int) -> None:
    symbols = codec("anoto").symbols((5000, 7000), (50, 40), (3, 4))
    page = np.full((40 * pixels, 50 * pixels), 255, np.uint8)
    for row, column in np.ndindex(symbols.shape):
        right, down = [(0, -1), (-1, 0), (1, 0), (0, 1)][symbols[row, column]]
        x, y = (column * 6 + 2 + right) * pixels // 6, (row * 6 + 2 + down) * pixels // 6
        page[y : y + dot, x : x + dot] = 0
    frame = page[3 * pixels : 30 * pixels, 4 * pixels : 40 * pixels]
    actual = localize_frames(frame[None].copy(), codec("anoto"))
    assert actual.rejected[0] == ""
    # A place is the middle of the dot that would stand on it.
    middle = np.array([4 * pixels + (36 * pixels - 1) / 2, 3 * pixels + (27 * pixels - 1) / 2])
    expected = np.array([5000, 7000]) + (middle - pixels / 3 - (dot - 1) / 2) / pixels
    np.testing.assert_allclose(actual.grid[0], expected, atol=0.01)
    assert actual.heading[0] == pytest.approx(0, abs=1e-3)
    assert actual.section[0].tolist() == [3, 4]


# --- frames without the pattern


def lattice(shot: Shots, k: int, rng: np.random.Generator, kind: str) -> Image:
    """Dots of the right size on the right grid, but for the code."""
    one = shots_of(shot, 1, 100 + k)[0]
    count = 2 * one.reach + 1
    symbols = {
        "random": rng.integers(0, 4, (count, count)),
        "one symbol": np.full((count, count), k % 4),
        "repeated": np.tile(rng.integers(0, 4, (3, 4)), (count, count))[:count, :count],
    }[kind]
    image: Image = shot(**{**vars_of(one), "symbols": symbols.astype(np.uint8)}).take()
    return image


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["random", "one symbol", "repeated"])
def test_grids_without_the_code(shot: Shots, kind: str) -> None:
    rng = np.random.default_rng(14)
    images = np.stack([lattice(shot, k, rng, kind) for k in range(20)])
    actual = localize_frames(images, codec("anoto"))
    assert not actual.accepted.any()
    assert actual.confidence.max() < 0.01


def test_the_pattern_in_a_mirror_and_as_a_negative(shot: Shots) -> None:
    images = np.stack([one.take() for one in shots_of(shot, 16, 15)])
    assert localize_frames(images, codec("anoto")).accepted.all()
    for wrong in (images[:, :, ::-1], images[:, ::-1], 255 - images):
        assert not localize_frames(np.ascontiguousarray(wrong), codec("anoto")).accepted.any()


def test_a_sheet_of_another_codec_has_other_positions(shot: Shots) -> None:
    # microdots and anoto share three of four sequences.
    images = np.stack([one.take() for one in shots_of(shot, 20, 16, codec="microdots")])
    assert not localize_frames(images, codec("anoto")).accepted.any()


def distractor_image(rng: np.random.Generator, kind: str, size: tuple[int, int]) -> Image:
    width, height = size
    y, x = np.mgrid[:height, :width].astype(float)
    a, pitch = rng.uniform(0, math.tau), rng.uniform(5, 20)
    u, v = x * math.cos(a) + y * math.sin(a), y * math.cos(a) - x * math.sin(a)
    grey: Array
    if kind == "text":
        page = np.full((height, width), 235, np.uint8)
        for line in range(10, height + 10, 14):
            words = "".join(chr(c) for c in rng.integers(33, 122, 40))
            cv2.putText(
                page, words, (2, line), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (30,), 1, cv2.LINE_AA
            )
        grey = page.astype(float)
    elif kind == "noise":
        grey = rng.uniform(0, 255, (height, width))
    elif kind == "soft noise":
        grey = cv2.GaussianBlur(rng.normal(0, 1, (height, width)), (0, 0), rng.uniform(1, 4))
        grey = 128 + 60 * grey / grey.std()
    elif kind == "checkerboard":
        grey = 40 + 180 * ((np.floor(u / pitch) + np.floor(v / pitch)) % 2)
    elif kind == "halftone":
        away = np.hypot(u / pitch % 1 - 0.5, v / pitch % 1 - 0.5)
        grey = np.where(away < rng.uniform(0.1, 0.4), 40.0, 220.0)
    elif kind == "lines":
        grey = np.where(np.minimum(u / pitch % 1, v / pitch % 1) < 0.2, 60.0, 210.0)
    elif kind == "gradient":
        grey = 120 + rng.uniform(-60, 60) * u / 100 + rng.uniform(-20, 20) * np.sin(v / 30)
    else:
        grey = np.full((height, width), {"black": 0.0, "white": 255.0, "paper": 200.0}[kind])
    spread = 0.0 if kind in ("black", "white") else rng.uniform(0.3, 5)
    return np.clip(np.rint(grey + rng.normal(0, spread, grey.shape)), 0, 255).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    ["text", "noise", "soft noise", "checkerboard", "halftone", "lines", "gradient", "black",
     "white", "paper"],
)  # fmt: skip
def test_frames_of_something_else(kind: str) -> None:
    rng = np.random.default_rng(17)
    for size, count in (((188, 120), 30), ((320, 240), 3)):
        images = np.stack([distractor_image(rng, kind, size) for _ in range(count)])
        actual = localize_frames(images, codec("anoto"))
        assert not actual.accepted.any()
        assert actual.confidence.max() < 0.5
        assert set(actual.rejected) <= {"too_few_dots", "no_grid", "no_code"}
        if kind in ("black", "white"):
            assert set(actual.rejected) == {"too_few_dots"}


@pytest.mark.parametrize("size", [(0, 0), (1, 1), (47, 300), (48, 48), (3000, 50)])
def test_frames_of_any_shape(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(18)
    images = rng.integers(0, 256, (2, size[1], size[0]), np.uint8)
    assert not localize_frames(images, codec("anoto")).accepted.any()


def test_no_frames() -> None:
    assert len(localize_frames(np.zeros((0, 120, 188), np.uint8), codec("anoto"))) == 0


def test_updates_keep_the_better_result() -> None:
    result = unlocalized_frames(4, "too_few_dots")
    result.confidence[:] = [0.5, 0.5, 0.5, 0.9]
    part = unlocalized_frames(4, "no_code")
    part.confidence[:] = [0.4, 0.6, 0.4, 0.9]
    part.rejected[2] = ""
    result.update(np.arange(4), part)
    # Worse; better; accepted although of less confidence; equal.
    assert result.rejected.tolist() == ["too_few_dots", "no_code", "", "no_code"]
    assert result.confidence.tolist() == [0.5, 0.6, 0.4, 0.9]


# --- what the dots say


def test_the_likelier_of_two_dots_of_a_cell_is_used() -> None:
    # At place (1, 0): a dot just where "right" stands, and dust on the other side of it.
    for order in ([0, 1], [1, 0]):
        rest = np.array([[1 / 6, 0.01], [-0.25, 0.1]], np.float32)[order]
        lattices = DotLattices(
            parameters=np.zeros((1, 9)),
            points=np.zeros((1, 2, 2), np.float32),
            valid=np.ones((1, 2), bool),
            uv=np.array([[[1, 0], [1, 0]]], np.float32) + rest,
            nodes=np.array([[[1, 0], [1, 0]]], np.float32),
            sigma=np.array([0.02]),
            fitted=np.ones(1, bool),
            lens=True,
        )
        column, row = soft_bits(lattices, 4)
        assert np.count_nonzero(column) == np.count_nonzero(row) == 1
        assert column[0, 4, 5] < -3  # right: column bit 0, row bit 1
        assert row[0, 4, 5] > 3


# --- for calibration


@pytest.mark.parametrize("known", [False, True])
def test_observations_are_dots_and_their_positions(shot: Shots, known: bool) -> None:
    camera = Camera((188, 120), 348.7, (93.5, 59.5), -0.045 * 348.7**2 / CORNER_SQUARE)
    (one,) = shots_of(shot, 1, 19, radial=camera.radial_px, noise=1.0)
    blank = np.full((120, 188), 200, np.uint8)
    images = np.stack([blank, one.take(), blank])
    (observed,) = dot_correspondences(images, codec("anoto"), camera if known else None)
    assert len(observed.pixels) > 120
    # From the place of each dot back to its pixel, through the renderer's own lens.
    away = observed.grid + observed.origin - one.at
    c, s = math.cos(one.heading), math.sin(one.heading)
    ideal = camera.centre_px + away @ np.array([[c, s], [-s, c]]) * one.pitch
    whole = (np.abs(observed.pixels - camera.centre_px) < [90, 56]).all(axis=1)
    np.testing.assert_allclose(observed.pixels[whole], camera.distort(ideal)[whole], atol=0.12)
    # A dot stands a sixth of a pitch beside its place, in one of four directions.
    aside = np.sort(np.abs(observed.grid - np.rint(observed.grid)), axis=1)
    np.testing.assert_allclose(aside, [[0, 1 / 6]] * len(aside), atol=1e-9)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_frames_of_other_depths_are_refused(kind: type) -> None:
    with pytest.raises(InputError, match="8 bits"):
        localize_frames(np.zeros((1, 120, 188), kind), codec("anoto"))
