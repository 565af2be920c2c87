"""Soft decoding: right where it answers, whatever of a window is seen."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.dots.codec import (
    MAIN_SEQUENCE,
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    Codec,
    codec,
    sequences,
)
from locatk.core.dots.identification import decoding
from locatk.core.dots.identification.decoding import MIN_CONFIDENCE, DecodedWindows
from locatk.core.errors import InputError

identify_windows = functools.partial(decoding.identify_windows, other_codec_odds=0)
"""The codec is certain, unless a test is about others."""

CODECS = ("anoto", "libdots", "microdots")
UP, LEFT, RIGHT, DOWN = range(4)

QUARTER = np.array([LEFT, DOWN, UP, RIGHT])
"""What up, left, right and down become in a page that is turned counter-clockwise."""

Bits = NDArray[np.float32]


class Windows:
    """n windows of ``columns`` x ``rows`` symbols, and all that is true of them."""

    def __init__(
        self,
        name: str,
        rng: np.random.Generator,
        n: int,
        columns: int,
        rows: int,
        x: Any = None,
        y: Any = None,
    ) -> None:
        one = codec(name)
        self.x = (
            rng.integers(0, SECTION_LENGTH - columns, n) if x is None else np.broadcast_to(x, n)
        )
        self.y = rng.integers(0, SECTION_LENGTH - rows, n) if y is None else np.broadcast_to(y, n)
        self.section = rng.integers(0, MAIN_SEQUENCE_LENGTH, (n, 2))
        # One by one is slow; that this is what Codec.symbols gives is tested below.
        across, down = np.arange(columns), np.arange(rows)
        column = one.phases(self.x[:, None] + across) + self.section[:, :1]
        row = one.phases(self.y[:, None] + down) + self.section[:, 1:]
        column_bit = MAIN_SEQUENCE[
            (column[:, None] + (self.y[:, None] + down)[..., None]) % MAIN_SEQUENCE_LENGTH
        ]
        row_bit = MAIN_SEQUENCE[
            (row[..., None] + (self.x[:, None] + across)[:, None]) % MAIN_SEQUENCE_LENGTH
        ]
        self.symbols = (column_bit + 2 * row_bit).astype(np.int64)
        self.turn = np.zeros(n, np.int64)

    def turned(self, quarters: int) -> Windows:
        """The same, seen turned counter-clockwise."""
        self.symbols = np.rot90(self.symbols, quarters, (1, 2))
        for _ in range(quarters):
            self.symbols = QUARTER[self.symbols]
        self.turn = (self.turn + quarters) % 4
        return self

    def right(self, actual: DecodedWindows) -> NDArray[np.bool_]:
        result: NDArray[np.bool_] = (
            (actual.x == self.x)
            & (actual.y == self.y)
            & (actual.section == self.section).all(axis=1)
            & (actual.rotation == self.turn)
        )
        return result


def soft(symbols: NDArray[np.int64], sure: float = 4.0) -> tuple[Bits, Bits]:
    """Column and row bits of symbols that are seen so surely."""
    return tuple(  # type: ignore[return-value]
        np.where(bit, sure, -sure).astype(np.float32) for bit in (symbols & 1, symbols >> 1)
    )


def flip(bits: tuple[Bits, Bits], share: float, rng: np.random.Generator) -> tuple[Bits, Bits]:
    """Bits of which this share is wrong; each as sure as is then justified."""
    sure = np.log((1 - share) / share)
    return tuple(  # type: ignore[return-value]
        (np.sign(b) * np.where(rng.random(b.shape) < share, -sure, sure)).astype(np.float32)
        for b in bits
    )


def hidden(bits: tuple[Bits, Bits], gone: NDArray[np.bool_]) -> tuple[Bits, Bits]:
    return np.where(gone, np.float32(0), bits[0]), np.where(gone, np.float32(0), bits[1])


def accepted(actual: DecodedWindows) -> NDArray[np.bool_]:
    """What a user takes for a place: sure enough, and in one section."""
    result: NDArray[np.bool_] = (actual.confidence >= MIN_CONFIDENCE) & ~actual.border
    return result


def fate(windows: Windows, bits: tuple[Bits, Bits], one: Codec) -> tuple[int, int, int]:
    """How many windows are read right, read wrong, and refused."""
    actual = identify_windows(*bits, one)
    took, right = accepted(actual), windows.right(actual)
    return int((took & right).sum()), int((took & ~right).sum()), int((~took).sum())


# --- whole windows


@pytest.mark.parametrize("name", CODECS)
def test_windows_of_this_test_are_the_codecs(name: str) -> None:
    windows = Windows(name, np.random.default_rng(1), 20, 9, 7)
    for k in range(20):
        np.testing.assert_array_equal(
            windows.symbols[k],
            codec(name).symbols(
                (int(windows.x[k]), int(windows.y[k])),
                (9, 7),
                (int(windows.section[k, 0]), int(windows.section[k, 1])),
            ),
        )


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("side", [8, 12])
@pytest.mark.parametrize("quarters", range(4))
def test_every_position_section_and_rotation(name: str, side: int, quarters: int) -> None:
    windows = Windows(name, np.random.default_rng(side), 1000, side, side).turned(quarters)
    actual = identify_windows(*soft(windows.symbols), codec(name))
    took = accepted(actual)
    assert took.all()
    np.testing.assert_array_equal(windows.right(actual), took)
    np.testing.assert_array_equal(actual.corrected, 0)
    np.testing.assert_array_equal(actual.dots, side * side)


@pytest.mark.parametrize("size", [(17, 11), (11, 17), (8, 20), (40, 9)])
@pytest.mark.parametrize("quarters", range(4))
def test_windows_that_are_not_square(size: tuple[int, int], quarters: int) -> None:
    windows = Windows("anoto", np.random.default_rng(2), 100, *size).turned(quarters)
    assert fate(windows, soft(windows.symbols), codec("anoto")) == (100, 0, 0)


@settings(max_examples=60, deadline=None)
@given(
    name=st.sampled_from(CODECS),
    x=st.integers(0, SECTION_LENGTH - 30),
    y=st.integers(0, SECTION_LENGTH - 30),
    u=st.integers(0, 62),
    v=st.integers(0, 62),
    side=st.integers(8, 30),
    quarters=st.integers(0, 3),
)
@example("anoto", 0, 0, 0, 0, 8, 0)
@example("anoto", SECTION_LENGTH - 30, SECTION_LENGTH - 30, 62, 62, 30, 2)
def test_any_window(name: str, x: int, y: int, u: int, v: int, side: int, quarters: int) -> None:
    symbols = np.rot90(codec(name).symbols((x, y), (side, side), (u, v)), quarters)
    for _ in range(quarters):
        symbols = QUARTER[symbols]
    actual = identify_windows(*soft(symbols[None].astype(np.int64)), codec(name))
    assert (actual.x[0], actual.y[0], *actual.section[0]) == (x, y, u, v)
    assert actual.rotation[0] == quarters
    assert actual.confidence[0] >= MIN_CONFIDENCE


def test_windows_at_the_rim_of_the_range() -> None:
    edge = [0, 1, SECTION_LENGTH - 13, SECTION_LENGTH - 12]
    for x in edge:
        for y in edge:
            windows = Windows("anoto", np.random.default_rng(3), 4, 12, 12, x, y)
            actual = identify_windows(*soft(windows.symbols), codec("anoto"))
            assert windows.right(actual).all(), (x, y)
            assert accepted(actual).all(), (x, y)


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("before", [(3, 0), (0, 4), (2, 5)])
def test_a_window_may_extend_before_the_first_positions(
    before: tuple[int, int], quarters: int
) -> None:
    # The frame on the upper left rim of a sheet at 0,0: its corner lies at places below 0.
    left, above = before
    windows = Windows("anoto", np.random.default_rng(4), 20, 16, 16, 0, 0)
    windows.symbols = np.pad(windows.symbols, ((0, 0), (above, 6 - above), (left, 6 - left)))
    gone = np.ones((22, 22), bool)
    gone[above : above + 16, left : left + 16] = False
    windows.turned(quarters)
    windows.x, windows.y = windows.x - left, windows.y - above
    bits = hidden(soft(windows.symbols), np.rot90(gone, quarters))
    assert fate(windows, bits, codec("anoto")) == (20, 0, 0)


@pytest.mark.slow
def test_answers_do_not_depend_on_their_company() -> None:
    rng = np.random.default_rng(5)
    windows = Windows("anoto", rng, 40, 10, 10)
    bits = flip(soft(windows.symbols), 0.03, rng)
    together = identify_windows(*bits, codec("anoto"))
    alone = [
        identify_windows(bits[0][k : k + 1], bits[1][k : k + 1], codec("anoto")) for k in range(40)
    ]
    for field in DecodedWindows.__dataclass_fields__:
        parts = np.concatenate([getattr(one, field) for one in alone])
        np.testing.assert_allclose(getattr(together, field), parts, rtol=1e-6, err_msg=field)


def test_nothing_to_decode() -> None:
    for n in (0, 3):
        nothing = np.zeros((n, 12, 12), np.float32)
        actual = identify_windows(nothing, nothing, codec("anoto"))
        assert len(actual.x) == n
        assert not accepted(actual).any()
        assert (actual.dots == 0).all()


# --- missing dots and wrong bits


@pytest.mark.slow
@pytest.mark.parametrize(("side", "share"), [(10, 0.1), (12, 0.3), (16, 0.5)])
def test_missing_dots(side: int, share: float) -> None:
    rng = np.random.default_rng(6)
    windows = Windows("anoto", rng, 400, side, side).turned(1)
    gone = rng.random(windows.symbols.shape) < share
    actual = identify_windows(*hidden(soft(windows.symbols), gone), codec("anoto"))
    took, right = accepted(actual), windows.right(actual)
    assert (took & right).sum() >= 394
    assert (took & ~right).sum() == 0
    np.testing.assert_array_equal(actual.dots, (~gone).sum(axis=(1, 2)))


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "least", "most"), [(1, 280, 0), (2, 200, 1), (3, 100, 1)])
def test_a_few_wrong_bits_of_8_by_8(wrong: int, least: int, most: int) -> None:
    # py-microdots reads 44 % right and 43 % wrong at one wrong bit, 19 and 55 % at two. Strings
    # of eight differ by two bits: not every wrong one can be told from a right one.
    rng = np.random.default_rng(wrong)
    windows = Windows("anoto", rng, 400, 8, 8)
    bits = np.stack(soft(windows.symbols), axis=1).reshape(400, -1)
    at = rng.permuted(np.tile(np.arange(128), (400, 1)), axis=1)[:, :wrong]
    np.put_along_axis(bits, at, -np.take_along_axis(bits, at, 1), 1)
    bits = bits.reshape(400, 2, 8, 8)
    actual = identify_windows(bits[:, 0].copy(), bits[:, 1].copy(), codec("anoto"))
    took, right = accepted(actual), windows.right(actual)
    assert (took & right).sum() >= least
    assert (took & ~right).sum() <= most
    assert (actual.corrected[took & right] == wrong).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side", "share", "least"), [(12, 0.03, 0.99), (16, 0.10, 0.9), (20, 0.15, 0.9)]
)
def test_many_wrong_bits_of_larger_windows(side: int, share: float, least: float) -> None:
    rng = np.random.default_rng(7)
    windows = Windows("anoto", rng, 200, side, side).turned(3)
    right, wrong, _ = fate(windows, flip(soft(windows.symbols), share, rng), codec("anoto"))
    assert right >= least * 200
    assert wrong == 0


@pytest.mark.slow
def test_bits_are_weighted_by_confidence() -> None:
    # A quarter of all bits is wrong, but says itself that it hardly knows.
    rng = np.random.default_rng(8)
    windows = Windows("anoto", rng, 200, 12, 12)
    bits = soft(windows.symbols)
    unsure = [rng.random(b.shape) < 0.25 for b in bits]
    faint = tuple(np.where(u, -0.1 * b, b).astype(np.float32)
                  for u, b in zip(unsure, bits, strict=True))  # fmt: skip
    right, wrong, _ = fate(windows, (faint[0], faint[1]), codec("anoto"))
    assert right >= 196
    assert wrong == 0
    loud = tuple(np.where(u, -b, b).astype(np.float32)
                 for u, b in zip(unsure, bits, strict=True))  # fmt: skip
    right, wrong, _ = fate(windows, (loud[0], loud[1]), codec("anoto"))
    assert (right, wrong) == (0, 0)


@pytest.mark.slow
def test_confidence_is_kept() -> None:
    """Fewer than 1 in 1,000 of what is accepted is wrong."""
    rng = np.random.default_rng(9)
    took = wrong = 0
    for name in CODECS:
        for side, share in [(8, 0.005), (9, 0.01), (10, 0.03), (12, 0.05), (16, 0.1)]:
            windows = Windows(name, rng, 120, side, side)
            right, bad, _ = fate(windows, flip(soft(windows.symbols), share, rng), codec(name))
            took, wrong = took + right + bad, wrong + bad
    assert took > 1200
    assert wrong <= took / 1000


# --- what cannot be told is not told


@pytest.mark.slow
@pytest.mark.parametrize("size", [(17, 5), (40, 5), (40, 4), (10, 5), (5, 17), (5, 40)])
@pytest.mark.parametrize("quarters", [0, 1])
def test_five_lines_have_many_positions(size: tuple[int, int], quarters: int) -> None:
    # Four shifts: each secondary sequence holds a string of four digits about three times.
    windows = Windows("anoto", np.random.default_rng(10), 60, *size).turned(quarters)
    _, wrong, _ = fate(windows, soft(windows.symbols), codec("anoto"))
    assert wrong == 0


@pytest.mark.slow
@pytest.mark.parametrize("side", [10, 12])
def test_windows_that_are_half_hidden(side: int) -> None:
    # A straight edge in any direction, as a hand or the rim of a sheet; one line too few.
    rng = np.random.default_rng(11)
    took = wrong = 0
    across, down = np.meshgrid(np.arange(side), np.arange(side))
    for share in (0.4, 0.5, 0.6):
        windows = Windows("anoto", rng, 120, side, side)
        angle = rng.uniform(0, 2 * np.pi, (120, 1, 1))
        along = np.cos(angle) * across + np.sin(angle) * down
        gone = along < np.quantile(along, share, axis=(1, 2), keepdims=True)
        right, bad, _ = fate(windows, hidden(soft(windows.symbols), gone), codec("anoto"))
        took, wrong = took + right, wrong + bad
    assert took > 25
    assert wrong == 0


def repeated() -> Iterator[tuple[int, int]]:
    """Places of the fourth libdots sequence where a string of so many digits occurs again."""
    digits = sequences.FOURTH_DIGITS["libdots"]
    for order in (5, 6):
        strings = [(digits + digits)[k : k + order] for k in range(len(digits))]
        for position, string in enumerate(strings):
            if strings.count(string) > 1:
                yield position, order


@pytest.mark.slow
def test_repeated_windows_of_libdots_are_ambiguous() -> None:
    one = codec("libdots")
    positions = list(repeated())
    assert len(positions) == 2 * (6 + 1)
    rng = np.random.default_rng(12)
    for position, order in positions:
        x = rng.integers(0, SECTION_LENGTH // 241 - 1, 10) * 241 + position
        windows = Windows("libdots", rng, 10, order + 1, 14, x)
        assert fate(windows, soft(windows.symbols), one) == (0, 0, 10), (position, order)
    longer = Windows("libdots", rng, 10, 9, 14, 241 * 1000 + positions[0][0])
    assert fate(longer, soft(longer.symbols), one) == (10, 0, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "n"), [((6, 6), 150), ((8, 8), 150), ((12, 12), 100), ((17, 11), 100), ((40, 40), 20)]
)
def test_noise_is_refused(size: tuple[int, int], n: int) -> None:
    rng = np.random.default_rng(13)
    shape = (n, size[1], size[0])
    for kind in range(3):
        bits = [
            (
                rng.choice([-4.0, 4.0], shape),
                rng.normal(0, 3, shape),
                rng.choice([-9.0, 9.0], shape) * (rng.random(shape) < 0.6),
            )[kind].astype(np.float32)
            for _ in range(2)
        ]
        assert not accepted(identify_windows(bits[0], bits[1], codec("anoto"))).any()


@pytest.mark.slow
@pytest.mark.parametrize("side", [8, 20])
def test_half_of_it_noise(side: int) -> None:
    rng = np.random.default_rng(14)
    for with_faults in (1, side // 4, side // 2, 3 * side // 4):
        windows = Windows("anoto", rng, 60, side, side)
        windows.symbols[:, :, :with_faults] = rng.integers(0, 4, (60, side, with_faults))
        right, wrong, _ = fate(windows, soft(windows.symbols), codec("anoto"))
        assert wrong == 0
        if (side, with_faults) == (20, 1):
            assert right == 60


@pytest.mark.parametrize("side", [8, 20])
def test_similar_patterns_are_refused(side: int) -> None:
    one = codec("anoto")
    original = Windows("anoto", np.random.default_rng(15), 40, side, side).symbols
    swap_x, swap_y = np.array([UP, RIGHT, LEFT, DOWN]), np.array([DOWN, LEFT, RIGHT, UP])
    for what, symbols in {
        "seen through the paper": swap_x[original[:, :, ::-1]],
        "seen in a mirror": swap_y[original[:, ::-1]],
        "the other way about the diagonal": np.array([LEFT, UP, DOWN, RIGHT])[
            original.transpose(0, 2, 1)
        ],
        "each dot on the other side": swap_x[swap_y[original]],
        "rows in another order": original[:, ::-1],
        "one symbol": np.tile(np.arange(4)[:, None, None], (1, side, side)),
        "stripes": np.tile(np.arange(side) % 2 * 3, (1, side, 1)),
    }.items():
        actual = identify_windows(*soft(np.ascontiguousarray(symbols)), one)
        assert not accepted(actual).any(), what


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side", "beyond"), [(8, 1), (12, 2), (16, 4), (16, 14), (20, 10), (20, 2)]
)
@pytest.mark.parametrize("axis", [0, 1])
def test_a_window_across_the_border_of_a_section(side: int, beyond: int, axis: int) -> None:
    rng = np.random.default_rng(16)
    n, start = 60, SECTION_LENGTH - side + beyond
    sizes = [(side - beyond, side), (beyond, side)]
    parts = [
        Windows("anoto", rng, n, *size, at).symbols
        for size, at in zip(sizes, (start, 0), strict=True)
    ]
    symbols = np.concatenate(parts, axis=2)
    if axis == 1:  # upright again, after the quarter turn that makes rows of columns
        symbols = QUARTER[QUARTER[QUARTER[np.rot90(symbols, 3, (1, 2))]]]
    actual = identify_windows(*soft(symbols), codec("anoto"))
    assert not (actual.confidence >= MIN_CONFIDENCE).any()
    if side == 20 and beyond == 2:  # most of it is of one section, so that its place is known
        assert actual.border.all()


# --- guards


def estimates(**changes: Any) -> decoding.WindowEstimates:
    """One window that was estimated beyond doubt, with some values changed."""
    certain = {"log_odds": 100.0, "order_log_odds": 100.0, "lead": 100.0}
    values: dict[str, Any] = {
        name: np.array([[certain[name]] * 2]) if name in certain else np.zeros((1, 2), np.int64)
        for name in decoding.WindowEstimates._fields
    }
    values["rotation"] = np.zeros(1, np.int64)
    values["last"] = np.full((1, 2), 7, np.int64)
    return decoding.WindowEstimates(**(values | changes))


@pytest.mark.parametrize(
    ("log_odds", "order_log_odds", "least", "most"),
    [
        (100.0, 100.0, 0.9999999, 1),
        (0.0, 100.0, 0.49, 0.51),
        (100.0, -5.0, 0.93, 0.95),
        (100.0, -10.0, 0.09, 0.11),
    ],
)
def test_evidence_against_random_bits_and_against_other_codecs(
    log_odds: float, order_log_odds: float, least: float, most: float
) -> None:
    bits = np.ones((1, 8, 8), np.float32)
    changes = {
        "log_odds": np.array([[log_odds, 100.0]]),
        "order_log_odds": np.array([[order_log_odds, 100.0]]),
    }
    (confidence,) = decoding.resolve_doubts(estimates(**changes), bits, bits, codec("anoto"))
    assert least <= confidence <= most


def test_windows_across_a_border_have_no_confidence() -> None:
    across = estimates(position=np.array([[SECTION_LENGTH - 3, 0]]))
    for window, border in ((across, True), (estimates(), False)):
        actual = decoding.as_decoded(window, np.array([0.9999]), np.array([64]), (0, 0))
        assert actual.border.tolist() == [border]
        assert actual.confidence.tolist() == [0.0 if border else 0.9999]


def test_windows_of_too_many_lines_are_refused() -> None:
    bits = np.zeros((1, 65, 8), np.float32)
    with pytest.raises(InputError, match="8 x 65 positions, more than 64"):
        identify_windows(bits, bits, codec("anoto"))
