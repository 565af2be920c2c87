"""Faults of a line: bytes that are lost on it, and bits that turn over."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError

BLOCK = 1024
"""Faults that are drawn at once."""


class Strikes:
    """Which of many trials in a row fail, each with the same probability on its own.

    Drawn are the gaps between failures, which are geometric: the effort goes with the
    failures, not with the trials, and where the trials are cut into pieces does not matter.
    """

    def __init__(self, probability: float, random: np.random.Generator) -> None:
        self._probability = probability
        self._random = random
        self._done = 0
        self._ahead = np.zeros(0, np.int64)

    def among(self, count: int) -> NDArray[np.int64]:
        """Places of the failures among the next ``count`` trials, ascending from 0."""
        start, self._done = self._done, self._done + count
        if self._probability == 0:
            return np.zeros(0, np.int64)
        blocks = [self._ahead]
        last = int(self._ahead[-1]) if len(self._ahead) else start - 1
        while last < self._done:
            # A gap is cut where it has no end: sums of them must stay within 64 bits.
            gaps = np.minimum(self._random.geometric(self._probability, BLOCK), 1 << 48)
            blocks.append(last + np.cumsum(gaps))
            last = int(blocks[-1][-1])
        ahead = np.concatenate(blocks)
        now = int(np.searchsorted(ahead, self._done))
        self._ahead = ahead[now:]
        return ahead[:now] - start


class Faults:
    """A line that loses bytes, and turns bits over in those that are left.

    The same seed strikes the same bytes of a stream, however it is cut into pieces.

    Parameters
    ----------
    drop, flip : float
        Probability of each byte to be lost, and of each bit to turn over.
    seed : int

    Attributes
    ----------
    dropped, flipped : int
        Bytes and bits so far.

    Raises
    ------
    InputError
        A probability is not in 0 to 1.
    """

    def __init__(self, drop: float = 0.0, flip: float = 0.0, seed: int = 0) -> None:
        for name, value in (("drop", drop), ("flip", flip)):
            if not 0 <= value <= 1:
                raise InputError(f"a probability to {name} of {value}", hint="Give 0 to 1")
        for_drops, for_flips = np.random.default_rng(seed).spawn(2)
        self._drops = Strikes(drop, for_drops)
        self._flips = Strikes(flip, for_flips)
        self.dropped = 0
        self.flipped = 0

    def spoil(self, data: bytes) -> bytes:
        """What arrives of the next bytes."""
        lost = self._drops.among(len(data))
        turned_count = 8 * (len(data) - len(lost))
        turned = self._flips.among(turned_count)
        if not len(lost) and not len(turned):
            return data
        left = np.delete(np.frombuffer(data, np.uint8), lost)
        np.bitwise_xor.at(left, turned // 8, (1 << (turned % 8)).astype(np.uint8))
        self.dropped += len(lost)
        self.flipped += len(turned)
        return left.tobytes()
