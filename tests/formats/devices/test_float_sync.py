"""Where frames of bare floats start, and whether floats are the next frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.polaris.mlx90393 import HALLCONF_SCALE, QUANTUM_UT
from locatk.formats.devices.float32.frame_matching import (
    LOOKAHEAD_FRAMES,
    FrameLayout,
    FrameModel,
    choose_phase,
    evaluate_phases,
    find_isolated_jumps,
    is_plausible,
    keeps_sensor_order,
)
from locatk.formats.devices.float32.synchronization import (
    DECISION_FRAMES,
    MIN_RUN_FRAMES,
    Acquisition,
    acquire,
    find_run,
    majority_position,
)

NINE, THREE, MAGX = FrameLayout(9), FrameLayout(3), FrameLayout(8, spare=1)
PUBLISHED_UT = (0.150, 0.242)


def frames(
    n: int, layout: FrameLayout = NINE, counts_ut: tuple[float, float] = PUBLISHED_UT, seed: int = 0
) -> np.ndarray:
    """(n, P) float32 of an array that stands still, in counts."""
    rng = np.random.default_rng(seed)
    xy, z = counts_ut
    count = np.array([xy, xy, z])
    field = rng.normal([10, -5, 40], 25, (layout.sensors, 3))
    noise_ut = np.maximum([0.9, 0.9, 1.2], 0.6 * count)
    noisy = field + rng.normal(size=(n, layout.sensors, 3)) * noise_ut
    values = np.zeros((n, layout.floats), "<f4")
    values[:, : 3 * layout.sensors] = (np.rint(noisy / count) * count).reshape(n, -1)
    return values


def found(
    data: bytes,
    pauses: tuple[int, ...] = (),
    layouts: tuple[FrameLayout, ...] = (NINE, THREE),
    first: int | None = 0,
    hint: FrameModel | None = None,
    decide: bool = False,
) -> Acquisition | None:
    return acquire(
        data, pauses, layouts, first=first, hint=hint, least=MIN_RUN_FRAMES, decide=decide
    )


def lock(values: np.ndarray) -> FrameModel:
    """A lock on frames that are known to start where they do."""
    settled = found(values.tobytes(), decide=True)
    assert settled is not None
    assert settled.start % NINE.size == 0
    return settled.model


# ---- floats


@pytest.mark.parametrize(
    ("value", "fine"),
    [
        (0.0, True),
        (-0.0, True),
        (0.15, True),
        (-4915.05, True),
        (3e5, True),
        (1e-5, False),
        (-1e6, False),
        (np.inf, False),
        (np.nan, True),
    ],
)
def test_fields_are_plausible(value: float, fine: bool) -> None:
    assert is_plausible(np.array([value], np.float32)).tolist() == [fine]


def test_not_all_bits_that_are_no_number_are_plausible() -> None:
    bits = np.array([0x7FC00000, 0xFFC00000, 0xFFFFFFFF, 0x7F800001], np.uint32)
    assert is_plausible(bits.view(np.float32)).tolist() == [True, True, False, False]


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    gain=st.integers(0, 7),
    resolution=st.integers(0, 3),
    scale=st.sampled_from(sorted(HALLCONF_SCALE.values())),
    seed=st.integers(0, 999),
)
def test_counts_are_learnt(gain: int, resolution: int, scale: float, seed: int) -> None:
    """Of all settings of the part, to the rounding of float32."""
    xy, z = (value * scale * 2**resolution for value in QUANTUM_UT[gain])
    settled = found(frames(DECISION_FRAMES + 2, counts_ut=(xy, z), seed=seed).tobytes())
    assert settled is not None
    np.testing.assert_allclose(settled.model.quantum, np.tile([xy, xy, z], 9), rtol=1e-6)


def test_values_that_are_no_counts_teach_none() -> None:
    noise = np.random.default_rng(1).normal(size=(DECISION_FRAMES + 2, 27)).astype("f4")
    settled = found((frames(DECISION_FRAMES + 2) + noise).astype("<f4").tobytes())
    assert settled is not None
    assert not settled.model.quantum.any()


def test_counts_are_learnt_in_spite_of_damage() -> None:
    values = frames(12)
    values[4, [3, 10, 20]] = [17.0801, -3.3333, 8e4]
    settled = found(values.tobytes(), pauses=(108, 216, 324, 432))
    assert settled is not None
    np.testing.assert_allclose(settled.model.quantum[:3], [0.15, 0.15, 0.242], rtol=1e-6)
    wild = settled.model.is_impossible(values)
    assert np.argwhere(wild).tolist() == [[4, 3], [4, 10], [4, 20]]


# ---- the start


@pytest.mark.parametrize("shift", [0, 1, 2, 3, 6, 55])
def test_a_run_is_found_within_garbage(shift: int) -> None:
    rng = np.random.default_rng(shift)
    values = frames(10)
    run = find_run(rng.bytes(300 + shift) + values.tobytes() + rng.bytes(333), 27, MIN_RUN_FRAMES)
    assert run is not None
    begin, floats = run
    assert (begin - 300 - shift) % 4 == 0
    # Of a window at its ends, a third may be garbage.
    assert abs(begin - 300 - shift) <= 4 * 13
    assert abs(len(floats) - values.size) <= 2 * 13


def test_garbage_has_no_run() -> None:
    rng = np.random.default_rng(0)
    assert find_run(rng.bytes(100_000), 27, MIN_RUN_FRAMES) is None
    assert find_run(b"", 27, MIN_RUN_FRAMES) is None
    assert find_run(frames(MIN_RUN_FRAMES - 1).tobytes(), 27, MIN_RUN_FRAMES) is None


def test_without_pauses_it_takes_some_frames_to_be_settled() -> None:
    data = frames(DECISION_FRAMES + 2).tobytes()
    assert found(data[: DECISION_FRAMES * 108]) is None
    settled = found(data)
    assert settled is not None
    assert (settled.start % 108, settled.assumption) == (0, "first")
    early = found(data[: 8 * 108], pauses=(216, 324, 432))
    assert early is not None
    assert (early.start % 108, early.assumption) == (0, "")


def test_a_wrong_start_is_no_start_of_a_sensor() -> None:
    """Z has other counts: of 27 places, 9 are left, and the nearest of them is a guess."""
    data = frames(DECISION_FRAMES + 3).tobytes()
    settled = found(data[20:])
    assert settled is not None
    assert settled.assumption == "guess"
    assert (settled.start + 20) % 12 == 0
    np.testing.assert_allclose(settled.model.quantum[:3], [0.15, 0.15, 0.242], rtol=1e-6)


def test_three_sensors_are_three_times_nine_floats() -> None:
    settled = found(frames(100, THREE).tobytes())
    assert settled is not None
    assert settled.model.layout == THREE
    assert not settled.model.is_unambiguous


def test_magx_tells_its_start_by_values_alone() -> None:
    data = frames(20, MAGX).tobytes()
    settled = found(data[30:], layouts=(MAGX,))
    assert settled is not None
    assert (settled.start + 30) % 100 == 0
    assert settled.model.is_unambiguous
    assert settled.model.ignored.tolist() == 24 * [False] + [True]


def test_the_hint_tells_the_start() -> None:
    values = frames(40)
    settled = found(values[20:].tobytes()[40:], hint=lock(values[:20]))
    assert settled is not None
    assert ((settled.start + 40) % 108, settled.assumption) == (0, "")
    # Another array is none of the hint's.
    other = found(frames(20, seed=9).tobytes()[40:], hint=lock(values[:20]))
    assert other is None


def test_equal_floats_are_no_frames() -> None:
    assert found(np.full((40, 27), 1.5, "<f4").tobytes(), decide=True) is None


@pytest.mark.parametrize(
    ("places", "winner"),
    [
        ([], None),
        ([5, 5], None),
        ([5, 5, 5], 5),
        ([0, 0, 0], 0),
        ([5, 5, 5, 2], 5),
        ([5, 5, 5, 2, 2], None),
        ([5, 5, 5, -1, -1, -1, -1], 5),
        ([5, 5, 5, *[-1] * 5], None),
        ([-1] * 9, None),
    ],
)
def test_majority(places: list[int], winner: int | None) -> None:
    assert majority_position(places) == winner


# ---- the next frame


@pytest.mark.parametrize("lost", [0, 1, 5, 12, 36, 96, 107])
def test_the_phase_after_a_loss(lost: int) -> None:
    values = frames(20)
    known = lock(values[:10])
    piece = values[10:].tobytes()[lost : lost + (LOOKAHEAD_FRAMES + 1) * 108]
    offset = np.arange(108)
    among = evaluate_phases(known, piece, offset)
    gone = (-offset) % 108
    choice = choose_phase(among, NINE, gone, np.zeros(108, np.int64))
    assert offset[choice.best] == -lost % 108
    assert choice.has_clear_lead
    assert choice.is_accepted
    assert choice.is_unambiguous
    assert choice.is_unshifted == (lost == 0)


def test_garbage_fits_no_phase() -> None:
    known = lock(frames(10))
    offset = np.arange(108)
    among = evaluate_phases(known, np.random.default_rng(0).bytes(540), offset)
    choice = choose_phase(among, NINE, offset[::-1].copy(), np.zeros(108, np.int64))
    assert not choice.is_accepted


def test_a_magnet_leaves_the_sensors_in_order() -> None:
    values = frames(12)
    known = lock(values[:10])
    before, after = values[10:11].astype(float), values[11:12].copy()
    after[0, 3:12] += np.float32([30.0, -60.0, 48.4, 90.0, 45.0, -121.0, 15.0, 30.0, 24.2])
    none = np.zeros((1, 27), bool)

    def ordered(frame: np.ndarray) -> bool:
        cost = known.cost(known.deviations(frame, before), none).sum(axis=1)
        return bool(keeps_sensor_order(known, frame, before, cost)[0])

    assert ordered(after)
    assert not ordered(np.roll(after, 3, axis=1))


def test_only_a_lonely_value_leaps() -> None:
    values = frames(12).astype(float)
    known = replace(lock(frames(12)), sigma=np.ones(27))
    values[:] = values[0]
    values[4, 7] += 60  # alone
    values[6, [9, 12]] += 60  # with a neighbour
    values[8:, 15] += 60  # for good
    values[9, 20] += 15  # noise
    apart = known.deviations(values[1:], values[:-1])
    assert np.argwhere(find_isolated_jumps(known, apart)).tolist() == [[3, 7]]


def test_a_lock_turns_with_its_sensors() -> None:
    values = frames(10)
    known = lock(values)
    turned = known.shifted(6)
    np.testing.assert_array_equal(turned.last, np.roll(known.last, -6))
    cost = turned.cost(turned.deviations(np.roll(values[9], -6)), np.zeros(27, bool))
    assert cost.mean() < 1.6
    assert known.cost(known.deviations(np.roll(values[9], -6)), np.zeros(27, bool)).mean() > 1.6


def test_frames_of_zeros_are_wild() -> None:
    known = lock(frames(10))
    values = frames(3)
    values[1] = 0
    values[2, 3:6] = 0
    assert known.is_impossible(values).any(axis=1).tolist() == [False, True, False]
