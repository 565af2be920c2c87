"""Whether floats are the next frame of an array of magnetometers: by their values alone.

Only fields are plausible floats, and they are whole numbers of counts. A frame goes on from
the one before, sensor by sensor, as sensors have offsets of tens of microtesla; a frame that
is read from a wrong byte on does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]
Bytes = NDArray[np.int64]

SMALLEST_UT, LARGEST_UT = 1e-4, 5e5
"""Fields that a magnetometer may tell, besides 0: from far below one count, as offsets may
have been taken off, to beyond the MLX90393's range at its coarsest settings."""

WRONG = 2.2
"""Cost above which a value is rather wrong than right: 2.8 widths."""

GOOD, FAIR = 1.6, 4.0
"""Mean cost of a float up to which a frame goes on beyond doubt, and up to which it may: of
the frames published, 98 % are below the first, and all of them, turned by a sensor or more,
above 2.5."""

STAY, SILENT, CLEAR = 10.0, 12.0, 25.0
"""In units of a frame's cost: what speaks for that nothing was lost, and for that a frame
starts after a pause; and how much better than any other a phase is that is believed though
most values have changed. Of the frames published, each is better by 28 than turned."""

SWING, LEAP, LEAP_UT = 4.0, 8.0, 20.0
"""Widths by which a value is away from the one before and the one after, which are close to
one another, where it moves, and where it was damaged if it moves alone; not by noise."""

LOOK = 4
"""Frames on each phase that are looked at after damage: it may spoil two."""

FEW = 2
"""Values of a frame that may be damaged without that it is in doubt."""

LAST_COUNT = 2**15
OTHER_COUNT = 0.05
"""How much larger a count of Z is than one of X and Y, at least (MLX90393: 0.61)."""

_CAP, _WILD = 9.0, 12.0
_CANONICAL_NAN = 0x7FC00000


@dataclass(frozen=True)
class Layout:
    """A frame: three floats a sensor, and ``spare`` ones that tell nothing."""

    sensors: int
    spare: int = 0

    @property
    def floats(self) -> int:
        return 3 * self.sensors + self.spare

    @property
    def size(self) -> int:
        """Bytes."""
        return 4 * self.floats


@dataclass(frozen=True)
class Lock:
    """What is known of a stream: enough to tell a frame from a piece of two.

    Attributes
    ----------
    layout : Layout
    last : (P,) ndarray
        The last good value of each float, in microtesla.
    width : (P,) ndarray
        How far values of two frames are apart while nothing moves: about 1 sigma.
    quantum : (P,) ndarray
        Of a count; 0 where values are no counts.
    blind : (P,) ndarray of bool
        Values that never tell anything.
    sure : bool
        Values alone tell where a frame starts.
    """

    layout: Layout
    last: Array
    width: Array
    quantum: Array
    blind: Mask
    sure: bool = False

    @property
    def step(self) -> int:
        """Floats by which a frame may be shifted without that values show it by their counts:
        three, where Z has another count than X and Y."""
        x, _, z = self.quantum[:3]
        told = x and z and abs(z / x - 1) > OTHER_COUNT
        return 3 if told and not self.layout.spare else 1

    def wild(self, values: Floats) -> Mask:
        """Which of (..., P) floats no such sensors can have sent; all, where all are zero, as
        of a line that is broken."""
        wild = ~plausible(values)
        wild |= ((values == 0) | self.blind).all(axis=-1, keepdims=True)
        counted = self.quantum > 0
        if counted.any():
            counts = values / np.where(counted, self.quantum, 1.0)
            off = np.abs(counts - np.rint(counts)) > rounding(counts)
            off |= np.abs(counts) > LAST_COUNT
            wild |= off & counted
        return wild

    def hurt(self, values: Floats) -> Mask:
        """Which of (..., P) floats were damaged: wild, but for those that always are."""
        return self.wild(values) & ~self.blind

    def apart(self, values: Floats, before: Array | Floats | None = None) -> Array:
        """By how many widths (..., P) floats differ from those before, by default from the
        last good ones; 0 where they tell nothing."""
        apart = (values - (self.last if before is None else before)) / self.width
        apart[..., self.blind] = 0.0
        return apart

    def cost(self, apart: Array, hurt: Mask) -> Array:
        """How ill floats go on that are so far apart: about 0.5 each where nothing moves, 4
        where it is another sensor's; from Cauchy's distribution."""
        cost = np.minimum(np.log1p(apart * apart), _CAP)
        cost[np.isnan(cost)] = WRONG
        cost[hurt] = _WILD
        return cost

    def followed(self, values: Floats, wild: Mask) -> Lock:
        """The lock after a good frame (P,)."""
        return replace(self, last=np.where(wild | np.isnan(values), self.last, values))

    def turned(self, floats: int) -> Lock:
        """The lock where a frame starts so many floats later."""
        parts = {
            name: np.roll(getattr(self, name), -floats)
            for name in ("last", "width", "quantum", "blind")
        }
        return replace(self, **parts)


@dataclass(frozen=True)
class Phases:
    """Frames that start at some of the bytes of one frame, and LOOK of them on each.

    Attributes
    ----------
    offset : (m,) ndarray
        The bytes.
    cost : (LOOK, m) ndarray
        How ill each frame goes on from the last good one; infinite beyond the data.
    few_hurt : (LOOK, m) ndarray of bool
        Hardly any of its values is damaged.
    sound : (LOOK, m) ndarray of bool
        No head of it is rather wrong than right, by the last good frame or the next.
    """

    offset: Bytes
    cost: Array
    few_hurt: Mask
    sound: Mask


@dataclass(frozen=True)
class Choice:
    """The likeliest phase.

    Attributes
    ----------
    best : int
        Its index.
    stays : bool
        It is the one where nothing was lost.
    leads : bool
        It is clearly better than any other.
    fits : bool
        It is to be believed.
    clear : bool
        There is no other that is about as likely.
    most : float
        Cost of a frame on it, at most; others on it are from before the damage.
    """

    best: int
    stays: bool
    leads: bool
    fits: bool
    clear: bool
    most: float = 0.0


def plausible(values: Floats) -> Mask:
    """Which floats may be fields in microtesla: of a sensible size, zero, or "no number" as a
    processor says it (not any bits that are none)."""
    size = np.abs(values)
    fine = (size >= SMALLEST_UT) & (size <= LARGEST_UT)
    bits = np.ascontiguousarray(values).view(np.uint32) & 0x7FFFFFFF
    found: Mask = fine | (bits == 0) | (bits == _CANONICAL_NAN)
    return found


def rounding(counts: Array) -> Array:
    """How far a number of counts may be from a whole one, by the rounding of float32."""
    most: Array = 1e-4 + 4e-7 * np.abs(counts)
    return most


@np.errstate(all="ignore")  # Any bytes are floats; many are no numbers.
def phases(lock: Lock, piece: bytes, offset: Bytes) -> Phases:
    """Frames that start at these bytes of a piece of up to LOOK + 1 frames."""
    size, there = lock.layout.size, len(piece)
    piece += bytes((LOOK + 1) * size + 4 - there)
    at_byte = np.empty(len(piece) - 4, np.float32)
    for shift in range(4):
        at_byte[shift::4] = np.frombuffer(piece, "<f4", len(at_byte) // 4, shift)
    starts = offset + size * np.arange(LOOK)[:, None]
    values = at_byte[starts[:, :, None] + 4 * np.arange(lock.layout.floats)]
    hurt = lock.hurt(values)
    cost = lock.cost(lock.apart(values), hurt)
    by_next = lock.cost(lock.apart(values[:-1], values[1:]), hurt[:-1])
    return Phases(
        offset,
        np.where(starts + size <= there, cost.sum(axis=2), np.inf),
        hurt.sum(axis=2) <= FEW,
        sound(np.concatenate([np.minimum(cost[:-1], by_next), cost[-1:]])),
    )


def choose(among: Phases, layout: Layout, lost: Bytes, pauses: NDArray[np.int64]) -> Choice:
    """The likeliest of phases, where (m,) bytes would have been lost, modulo a frame, and
    where so many pauses are before frames."""
    # Of the frames on the right phase, damage may have spoilt all but two.
    cost = np.sort(among.cost, axis=0)[:2]
    total = np.where(np.isinf(cost[1]), 2 * cost[0], cost.sum(axis=0))
    total += 0.02 * np.minimum(lost, layout.size - lost) - SILENT * pauses
    total[lost == 0] -= STAY
    best = int(np.argmin(total))
    stays = bool(lost[best] == 0)
    used = cost[:, best][np.isfinite(cost[:, best])]
    if not len(used):
        return Choice(best, stays, leads=False, fits=False, clear=True)
    mean = float(used.mean()) / layout.floats
    lead = float(np.delete(total, best).min(initial=np.inf) - total[best])
    leads = lead >= CLEAR and (mean <= FAIR or bool(pauses[best] >= LOOK - 1))
    clear = stays or lead >= STAY / 2
    most = (1.5 * mean + 0.5) * layout.floats
    return Choice(best, stays, leads, leads or mean <= GOOD, clear, most)


def in_order(lock: Lock, frames: Floats, before: Array, cost: Array) -> Mask:
    """Whether (n, P) frames that are far from those before would clearly be still farther if
    they began at another sensor: then a magnet has moved."""
    fits = np.ones(len(frames), bool)
    for floats in range(lock.step, lock.layout.floats, lock.step):
        turned = np.roll(frames, floats, axis=1)
        turned_cost = lock.cost(lock.apart(turned, before), lock.hurt(turned))
        fits &= turned_cost.sum(axis=1) >= cost + CLEAR
    return fits


def leaps(lock: Lock, apart: Array) -> Mask:
    """Which values of all but the last of (n, P) frames are away, alone, from those before
    and after, and these close to one another, where the sensor's other axes stand still. No
    magnet does that, as its neighbours see it too; a flipped bit does."""
    sensors = lock.layout.sensors
    back, on = np.abs(apart[:-1]), np.abs(apart[1:])
    if not (back > LEAP).any():
        return np.zeros(back.shape, bool)
    swings = (np.abs(apart[:-1] + apart[1:]) < SWING) & (np.minimum(back, on) > SWING)
    moves = (np.maximum(back, on) > SWING)[:, : 3 * sensors].reshape(-1, sensors, 3)
    found = np.zeros(back.shape, bool)
    found[:, : 3 * sensors] = np.repeat(moves.sum(axis=2) == 1, 3, axis=1)
    found &= swings & (swings.sum(axis=1, keepdims=True) == 1)
    return found & (np.minimum(back, on) > np.maximum(LEAP, LEAP_UT / lock.width))


def sound(cost: Array) -> Mask:
    """Which (..., P) costs have no head that is rather wrong than right."""
    return np.asarray((np.cumsum(cost - WRONG, axis=-1) <= 1.0).all(axis=-1))
