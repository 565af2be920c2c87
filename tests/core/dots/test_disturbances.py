"""Frames under tilt, lenses, hands, ink and glare, from the renderer of the benchmark."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.dots.codec import codec
from locatk.core.dots.detection.blobs import detect_dots
from locatk.core.dots.identification.decoding import identify_windows
from locatk.core.dots.localization.frames import localize_frames
from locatk.formats.benchmarks.dots.disturbances import DISTURBANCES, Disturbance, render, score


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("tilt of 30 to 40 deg", 6),
        ("barrel of 30 %", 6),
        ("64 x 64 px, 8 x 8 dots", 5),
        ("hand over 50 %", 5),
        ("hand over 65 %", 3),
        ("thick lines", 5),
        ("text", 5),
    ],
)
def test_disturbed_frames_are_read(name: str, least: int) -> None:
    frames = render(DISTURBANCES[name], 6, 31)
    result = score(frames, localize_frames(frames.images, codec("anoto")))
    assert result.correct.sum() >= least
    assert not result.wrong.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "limits"),
    [("defocus on one side", (0.5, 2.7)), ("pincushion of 30 %", (0.15, 2.0))],
)
def test_covariances_agree_with_the_errors(name: str, limits: tuple[float, float]) -> None:
    frames = render(DISTURBANCES[name], 16, 35)
    result = score(frames, localize_frames(frames.images, codec("anoto"), other_codec_odds=0))
    assert result.correct.all()
    assert limits[0] < result.nees[:2].mean() < limits[1]


@pytest.mark.slow
def test_frames_of_a_level_camera_agree_with_the_truth() -> None:
    """The truth of the renderer is that of the solver within a hundredth of a pitch."""
    frames = render(Disturbance(noise=0.0), 3, 32)
    located = localize_frames(frames.images, codec("anoto"))
    assert located.accepted.all()
    np.testing.assert_allclose(located.grid, frames.grid, atol=2e-3)
    np.testing.assert_allclose(np.exp(1j * (located.heading - frames.heading)), 1, atol=1e-3)


def test_lines_and_their_edges_have_no_dots() -> None:
    rng = np.random.default_rng(33)
    paper = rng.normal(200, 2, (1, 120, 188))
    paper[0, :, 60:90] -= 140
    for x, y in rng.uniform((105, 5), (183, 115), (60, 2)):
        dy, dx = np.mgrid[:120, :188] - np.array([y, x])[:, None, None]
        paper[0] -= 110 * np.exp(-(dx**2 + dy**2) / 4)
    dots = detect_dots(np.clip(np.rint(paper), 0, 255).astype(np.uint8))
    x = dots.xy[0, dots.valid[0], 0]
    assert len(x) > 30
    assert not ((x > 55) & (x < 95)).any()


def test_a_wide_strip_of_short_columns_is_decoded_by_a_second_search() -> None:
    """Columns of four dots have many likely phases; their order decides."""
    rng = np.random.default_rng(34)
    found = {True: 0, False: 0}
    for _ in range(12):
        x, y = (int(value) for value in rng.integers(1_000_000, 400_000_000, 2))
        symbols = codec("anoto").symbols((x, y), (18, 18))
        bits = [np.where(symbols & bit, 7.0, -7.0).astype(np.float32) for bit in (1, 2)]
        rows, columns = np.indices((18, 18))
        hidden = np.abs(rows - columns * 0.5 - 4.5) > 1.8
        for table in bits:
            table[hidden] = 0
        for is_thorough in found:
            windows = identify_windows(
                bits[0][None],
                bits[1][None],
                codec("anoto"),
                is_thorough=is_thorough,
                other_codec_odds=0,
            )
            is_right = windows.x[0] == x and windows.y[0] == y
            assert is_right or windows.confidence[0] < 0.999
            found[is_thorough] += bool(windows.confidence[0] >= 0.999)
    assert found[True] >= found[False] + 2
    assert found[True] >= 6
