"""Decision whether bare floats are the next frame of an array of magnetometers, by their values.

Only magnetic fields are plausible floats, and they are integer multiples of an ADC count. The
offsets of sensors differ by tens of microtesla. Therefore the values of a frame are close to
those of the previous frame, sensor by sensor, and those of a frame read from a wrong byte are
not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]
Bytes = NDArray[np.int64]

MIN_FIELD_UT, MAX_FIELD_UT = 1e-4, 5e5
"""Plausible magnitudes besides 0: from far below one count, because offsets may have been
subtracted, to beyond the range of the MLX90393 at its coarsest settings."""

WRONG_VALUE_COST = 2.2
"""Cost above which a value is more likely wrong than right: 2.8 sigma."""

GOOD_MEAN_COST, FAIR_MEAN_COST = 1.6, 4.0
"""Mean cost per float up to which a frame certainly continues the stream, and up to which it
may. Of the published frames, 98 % are below the first value; all of them, shifted by one sensor
or more, are above 2.5."""

UNSHIFTED_COST_BONUS, PAUSE_COST_BONUS, MIN_COST_LEAD = 10.0, 12.0, 25.0
"""In units of a frame's cost: bonus of the phase without lost bytes; bonus of a frame after a
pause of the line; lead over any other phase with which a phase is accepted although most values
have changed. Each of the published frames leads its shifted versions by 28."""

MAX_SETTLED_SIGMAS, MIN_JUMP_SIGMAS, MIN_JUMP_UT = 4.0, 8.0, 20.0
"""Differences of a value from its neighbours in time: largest one between neighbours that agree;
smallest one of a damaged value, in sigmas and in microtesla, which noise does not reach."""

LOOKAHEAD_FRAMES = 4
"""Frames evaluated on each phase after damage, which may affect two of them."""

MAX_DAMAGED_VALUES = 2
"""Damaged values with which a frame is still accepted."""

MAX_ADC_COUNTS = 2**15

MIN_QUANTUM_DIFFERENCE = 0.05
"""Smallest relative difference between the count of Z and that of X and Y (MLX90393: 0.61)."""

_MAX_VALUE_COST, _DAMAGED_VALUE_COST = 9.0, 12.0
_CANONICAL_NAN = 0x7FC00000


@dataclass(frozen=True)
class FrameLayout:
    """Layout of a frame: three floats per sensor, and ``spare`` floats without meaning."""

    sensors: int
    spare: int = 0

    @property
    def floats(self) -> int:
        """Number of floats."""
        return 3 * self.sensors + self.spare

    @property
    def size(self) -> int:
        """Size in bytes."""
        return 4 * self.floats


@dataclass(frozen=True)
class FrameModel:
    """Expected values of the next frame, and their noise.

    Attributes
    ----------
    layout : FrameLayout
    last : (P,) ndarray
        Last valid value of each float, in microtesla.
    sigma : (P,) ndarray
        Typical difference between two frames at rest, in microtesla.
    quantum : (P,) ndarray
        ADC count in microtesla; 0 if values are no multiples of one.
    ignored : (P,) ndarray of bool
        Values without information, such as those of a broken sensor.
    is_unambiguous : bool
        Values alone determine the start of a frame.
    """

    layout: FrameLayout
    last: Array
    sigma: Array
    quantum: Array
    ignored: Mask
    is_unambiguous: bool = False

    @property
    def shift_step(self) -> int:
        """Smallest shift in floats that keeps the counts of all axes: 3 if Z has its own count."""
        x, _, z = self.quantum[:3]
        is_z_distinct = x and z and abs(z / x - 1) > MIN_QUANTUM_DIFFERENCE
        return 3 if is_z_distinct and not self.layout.spare else 1

    def is_impossible(self, values: Floats) -> Mask:
        """Return which of (..., P) floats these sensors cannot have sent.

        All values of a frame of zeros are impossible, because a broken line sends zeros.
        """
        impossible = ~is_plausible(values)
        impossible |= ((values == 0) | self.ignored).all(axis=-1, keepdims=True)
        has_quantum = self.quantum > 0
        if has_quantum.any():
            counts = values / np.where(has_quantum, self.quantum, 1.0)
            is_off = np.abs(counts - np.rint(counts)) > rounding_tolerance(counts)
            is_off |= np.abs(counts) > MAX_ADC_COUNTS
            impossible |= is_off & has_quantum
        return impossible

    def is_damaged(self, values: Floats) -> Mask:
        """Return which of (..., P) floats are impossible and not ignored."""
        return self.is_impossible(values) & ~self.ignored

    def deviations(self, values: Floats, before: Array | Floats | None = None) -> Array:
        """Return the differences of (..., P) floats from ``before``, in sigmas.

        ``before`` defaults to the last valid values. Ignored values give 0.
        """
        deviations = (values - (self.last if before is None else before)) / self.sigma
        deviations[..., self.ignored] = 0.0
        return deviations

    def cost(self, deviations: Array, damaged: Mask) -> Array:
        """Return the cost of deviations: the negative log-likelihood of a Cauchy distribution.

        It is about 0.5 per value at rest, and 4 for values of another sensor.
        """
        cost = np.minimum(np.log1p(deviations * deviations), _MAX_VALUE_COST)
        cost[np.isnan(cost)] = WRONG_VALUE_COST
        cost[damaged] = _DAMAGED_VALUE_COST
        return cost

    def updated(self, values: Floats, impossible: Mask) -> FrameModel:
        """Return the model after a valid frame (P,)."""
        return replace(self, last=np.where(impossible | np.isnan(values), self.last, values))

    def shifted(self, floats: int) -> FrameModel:
        """Return the model of frames that start so many floats later."""
        names = ("last", "sigma", "quantum", "ignored")
        return replace(self, **{name: np.roll(getattr(self, name), -floats) for name in names})


@dataclass(frozen=True)
class PhaseCosts:
    """Costs of frames on several phases, LOOKAHEAD_FRAMES on each.

    A phase is the position of the start of a frame, modulo the size of a frame.

    Attributes
    ----------
    offset : (m,) ndarray
        Phases in bytes.
    cost : (LOOKAHEAD_FRAMES, m) ndarray
        Cost of each frame against the last valid one; infinite beyond the data.
    is_mostly_intact : (LOOKAHEAD_FRAMES, m) ndarray of bool
        At most MAX_DAMAGED_VALUES of its values are damaged.
    is_sound : (LOOKAHEAD_FRAMES, m) ndarray of bool
        No leading part of it is more likely wrong than right, against the last valid frame
        or the next one.
    """

    offset: Bytes
    cost: Array
    is_mostly_intact: Mask
    is_sound: Mask


@dataclass(frozen=True)
class PhaseChoice:
    """The most likely phase.

    Attributes
    ----------
    best : int
        Its index.
    is_unshifted : bool
        It is the phase without lost bytes.
    has_clear_lead : bool
        Its cost is much lower than that of any other phase.
    is_accepted : bool
        Its frames continue the stream.
    is_unambiguous : bool
        No other phase is about as likely.
    max_cost : float
        Largest cost of a frame on it; frames of larger cost are from before the damage.
    """

    best: int
    is_unshifted: bool
    has_clear_lead: bool
    is_accepted: bool
    is_unambiguous: bool
    max_cost: float = 0.0


def is_plausible(values: Floats) -> Mask:
    """Return which floats may be fields in microtesla.

    These are values of a plausible magnitude, zero, and the canonical NaN of processors, but
    not other NaN bit patterns.
    """
    size = np.abs(values)
    in_range = (size >= MIN_FIELD_UT) & (size <= MAX_FIELD_UT)
    bits = np.ascontiguousarray(values).view(np.uint32) & 0x7FFFFFFF
    plausible: Mask = in_range | (bits == 0) | (bits == _CANONICAL_NAN)
    return plausible


def rounding_tolerance(counts: Array) -> Array:
    """Return the largest distance of counts from integers that float32 rounding explains."""
    tolerance: Array = 1e-4 + 4e-7 * np.abs(counts)
    return tolerance


@np.errstate(all="ignore")  # Any bytes are floats; many of them are NaN.
def evaluate_phases(model: FrameModel, piece: bytes, offset: Bytes) -> PhaseCosts:
    """Return the costs of frames that start at ``offset`` and follow each other in ``piece``.

    ``piece`` has up to LOOKAHEAD_FRAMES + 1 frames.
    """
    size, available = model.layout.size, len(piece)
    piece += bytes((LOOKAHEAD_FRAMES + 1) * size + 4 - available)
    at_byte = np.empty(len(piece) - 4, np.float32)
    for shift in range(4):
        at_byte[shift::4] = np.frombuffer(piece, "<f4", len(at_byte) // 4, shift)
    starts = offset + size * np.arange(LOOKAHEAD_FRAMES)[:, None]
    values = at_byte[starts[:, :, None] + 4 * np.arange(model.layout.floats)]
    damaged = model.is_damaged(values)
    cost = model.cost(model.deviations(values), damaged)
    cost_to_next = model.cost(model.deviations(values[:-1], values[1:]), damaged[:-1])
    lower_cost = np.concatenate([np.minimum(cost[:-1], cost_to_next), cost[-1:]])
    return PhaseCosts(
        offset,
        np.where(starts + size <= available, cost.sum(axis=2), np.inf),
        damaged.sum(axis=2) <= MAX_DAMAGED_VALUES,
        has_sound_prefixes(lower_cost),
    )


def choose_phase(
    candidates: PhaseCosts, layout: FrameLayout, lost: Bytes, pauses: NDArray[np.int64]
) -> PhaseChoice:
    """Return the most likely phase.

    Parameters
    ----------
    candidates : PhaseCosts
    layout : FrameLayout
    lost : (m,) ndarray
        Bytes that each phase implies to be lost, modulo a frame.
    pauses : (m,) ndarray
        Pauses of the line before the frames of each phase.
    """
    # Of the frames on the right phase, damage may have affected all but two.
    cost = np.sort(candidates.cost, axis=0)[:2]
    total = np.where(np.isinf(cost[1]), 2 * cost[0], cost.sum(axis=0))
    total += 0.02 * np.minimum(lost, layout.size - lost) - PAUSE_COST_BONUS * pauses
    total[lost == 0] -= UNSHIFTED_COST_BONUS
    best = int(np.argmin(total))
    is_unshifted = bool(lost[best] == 0)
    used = cost[:, best][np.isfinite(cost[:, best])]
    if not len(used):
        return PhaseChoice(
            best, is_unshifted, has_clear_lead=False, is_accepted=False, is_unambiguous=True
        )
    mean = float(used.mean()) / layout.floats
    lead = float(np.delete(total, best).min(initial=np.inf) - total[best])
    follows_pauses = bool(pauses[best] >= LOOKAHEAD_FRAMES - 1)
    has_clear_lead = lead >= MIN_COST_LEAD and (mean <= FAIR_MEAN_COST or follows_pauses)
    return PhaseChoice(
        best,
        is_unshifted,
        has_clear_lead,
        is_accepted=has_clear_lead or mean <= GOOD_MEAN_COST,
        is_unambiguous=is_unshifted or lead >= UNSHIFTED_COST_BONUS / 2,
        max_cost=(1.5 * mean + 0.5) * layout.floats,
    )


def keeps_sensor_order(model: FrameModel, frames: Floats, before: Array, cost: Array) -> Mask:
    """Return which of (n, P) frames of high cost would cost clearly more if they were shifted.

    Then a magnet has moved, and no byte was lost.
    """
    keeps_order = np.ones(len(frames), bool)
    for floats in range(model.shift_step, model.layout.floats, model.shift_step):
        shifted = np.roll(frames, floats, axis=1)
        shifted_cost = model.cost(model.deviations(shifted, before), model.is_damaged(shifted))
        keeps_order &= shifted_cost.sum(axis=1) >= cost + MIN_COST_LEAD
    return keeps_order


def find_isolated_jumps(model: FrameModel, deviations: Array) -> Mask:
    """Return which values of all but the last of (n, P) frames jump alone, for one frame.

    The values before and after agree, and the other axes of the sensor rest. A magnet does not
    cause that, because neighbouring sensors measure it too; a flipped bit does.
    """
    sensors = model.layout.sensors
    to_previous, to_next = np.abs(deviations[:-1]), np.abs(deviations[1:])
    if not (to_previous > MIN_JUMP_SIGMAS).any():
        return np.zeros(to_previous.shape, bool)
    smaller = np.minimum(to_previous, to_next)
    returns = np.abs(deviations[:-1] + deviations[1:]) < MAX_SETTLED_SIGMAS
    returns &= smaller > MAX_SETTLED_SIGMAS
    moves = (np.maximum(to_previous, to_next) > MAX_SETTLED_SIGMAS)[:, : 3 * sensors]
    moves = moves.reshape(-1, sensors, 3)
    is_jump = np.zeros(to_previous.shape, bool)
    is_jump[:, : 3 * sensors] = np.repeat(moves.sum(axis=2) == 1, 3, axis=1)
    is_jump &= returns & (returns.sum(axis=1, keepdims=True) == 1)
    return is_jump & (smaller > np.maximum(MIN_JUMP_SIGMAS, MIN_JUMP_UT / model.sigma))


def has_sound_prefixes(cost: Array) -> Mask:
    """Return which (..., P) costs have no leading part that is more likely wrong than right."""
    return np.asarray((np.cumsum(cost - WRONG_VALUE_COST, axis=-1) <= 1.0).all(axis=-1))
