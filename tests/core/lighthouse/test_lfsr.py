"""The bit sequences, against the register run step by step and against published examples."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import PERIOD_TICKS, TICKS_PER_COUNT

CHECKPOINTS = (1, 0b10000000000011010, 0b10000001010110001, 0b10111000000110000)
"""Polynomial 0, of DotBot-firmware ``bsp/nrf/lh2.c``."""

WINDOWS = (
    (0b1110000100011111111001110010111000000100001001100011001010001110, 3, 49341),
    (0b1011101111101010101101010010101010100100111101101001000111011100, 1, 85887),
    (0b1100001000111111110011100101110000001000010011000110010100011100, 2, 49341),
    (0b0111011111010101011010100101010101001001111011010010001110111000, 0, 85887),
)
"""Bits, offset and count of polynomial 1, of PyDotBot's ``test_lighthouse2.py``."""

PULSES = (
    (0, 0x1A639, 28992),
    (0, 0x175A5, 70714),
    (1, 0x11C42, 28992),
    (1, 0x1511F, 70711),
)
"""Polynomial, beam word and sync offset of a Lighthouse deck: lighthouse-fpga's readme."""


def run(polynomial: int, steps: int) -> list[int]:
    """States of the register as the definition says, one step after the other."""
    mask = int(lfsr.TAPS[polynomial])
    states = [1]
    for _ in range(steps):
        state = states[-1]
        states.append((state << 1 | (state & mask).bit_count() & 1) & 0x1FFFF)
    return states


def test_all_polynomials_pass_through_every_state() -> None:
    index = np.arange(lfsr.SEQUENCE_LENGTH)
    for polynomial in range(32):
        states = lfsr.state_at(index, polynomial)
        assert np.array_equal(np.sort(states), index + 1)
        assert np.array_equal(lfsr.indices(states, polynomial), index)
        # Each state follows from the one before, around to the first.
        parity = np.bitwise_count(states & lfsr.TAPS[polynomial]) & 1
        assert np.array_equal(np.roll(states, -1), (states << 1 | parity) & 0x1FFFF)
        assert states[0] == 1


@pytest.mark.parametrize("polynomial", [0, 5, 31])
def test_register_run_step_by_step(polynomial: int) -> None:
    states = run(polynomial, lfsr.SEQUENCE_LENGTH)
    assert states.pop() == 1
    assert lfsr.indices(states, polynomial).tolist() == list(range(lfsr.SEQUENCE_LENGTH))


def test_checkpoints_of_dotbot() -> None:
    index = lfsr.indices(CHECKPOINTS, 0)
    # They subtract 1 from 2048 k, because the state is the one before.
    assert index.tolist() == [0, 2047, 4095, 6143]


@pytest.mark.parametrize(("bits", "offset", "count"), WINDOWS)
def test_counts_of_pydotbot(bits: int, offset: int, count: int) -> None:
    assert lfsr.indices(bits >> (47 - offset) & 0x1FFFF, 1) == count


@pytest.mark.parametrize(("polynomial", "word", "offset"), PULSES)
def test_offsets_of_the_deck(polynomial: int, word: int, offset: int) -> None:
    assert lfsr.indices(word, polynomial) == offset
    assert lfsr.state_at(offset, polynomial) == word


def test_state_without_place() -> None:
    assert np.all(lfsr.indices(np.zeros(32, int), np.arange(32)) == lfsr.NO_INDEX)


def test_no_index_repeats_within_a_revolution() -> None:
    assert PERIOD_TICKS.max() / TICKS_PER_COUNT < lfsr.SEQUENCE_LENGTH


@pytest.mark.parametrize("length", [1, 16, 17, 18, 51, 63, 64])
def test_bits_are_the_sequence(length: int) -> None:
    index = np.array([0, 1, 77_777, lfsr.SEQUENCE_LENGTH - 1])
    for polynomial in (0, 7, 30):
        # The sequence is the highest bit of each state.
        each = lfsr.state_at(index[:, None] + np.arange(length), polynomial) >> 16
        expected = [int("".join(map(str, row)), 2) for row in each.tolist()]
        assert lfsr.bits_at(index, polynomial, length).tolist() == expected


def test_bits_of_a_published_window() -> None:
    # Its last bit is no light: the demodulator shifts once more.
    bits, offset, count = WINDOWS[1]
    mine = int(lfsr.bits_at(count, 1, 60 - offset))
    theirs = bits >> 4 & (1 << 60 - offset) - 1
    assert (mine ^ theirs).bit_count() == 0


def test_shapes_go_together() -> None:
    index = np.arange(12).reshape(3, 1, 4) * 9001
    polynomial = np.array([[2], [9]])
    states = lfsr.state_at(index, polynomial)
    assert states.shape == lfsr.bits_at(index, polynomial).shape == (3, 2, 4)
    assert np.array_equal(lfsr.indices(states, polynomial), np.broadcast_to(index, (3, 2, 4)))
