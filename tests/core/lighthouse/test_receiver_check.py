"""Check of photodiodes, with a published recording of a tracker and with simulated decks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.receiver_check import check_receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.simulation.session import SimulationOptions, simulate


@pytest.fixture(scope="module")
def sweeps() -> Sweeps:
    """Sweeps of a Lighthouse deck that is moved by hand."""
    options = SimulationOptions(planar=False, duration_s=3.0, receiver=DECK, seed=3)
    return simulate(options).sweeps


def _exchanged(receiver: Receiver, first: int, second: int) -> Receiver:
    position = receiver.position_m.copy()
    position[[first, second]] = position[[second, first]]
    return replace(receiver, position_m=position)


def _codes(check: Any) -> list[tuple[int | None, str]]:
    return [(fault.sensor, fault.code) for fault in check.faults]


def test_a_correct_deck_has_no_fault(sweeps: Sweeps) -> None:
    check = check_receiver(sweeps, 0, DECK)
    assert not check.faults
    assert not check.untested
    assert [figures.channels for figures in check.sensors] == [(1, 2)] * 4


@pytest.mark.parametrize(
    ("exchanged", "explanations"),
    [
        ((0, 1), {(0, 1)}),
        ((0, 2), {(0, 2)}),
        # A deck that is rotated by 180 degrees looks the same.
        ((0, 3), {(0, 3), (1, 2)}),
        ((1, 2), {(0, 3), (1, 2)}),
    ],
)
def test_exchanged_photodiodes_are_named(
    sweeps: Sweeps, exchanged: tuple[int, int], explanations: set[tuple[int, int]]
) -> None:
    check = check_receiver(sweeps, 0, _exchanged(DECK, *exchanged))
    assert _codes(check) == [(None, "order")]
    assert any(f"{a} and {b} are exchanged" in check.faults[0].message for a, b in explanations)


def test_other_positions_do_not_fit(sweeps: Sweeps) -> None:
    position = DECK.position_m.copy()
    position[0, 0] += 0.012
    check = check_receiver(sweeps, 0, replace(DECK, position_m=position))
    assert _codes(check) == [(None, "order")]
    assert "do not fit" in check.faults[0].message


def test_photodiodes_without_light_are_named(sweeps: Sweeps) -> None:
    rng = np.random.default_rng(0)
    is_kept = (sweeps.sensor != 1) & ((sweeps.sensor != 2) | (rng.random(len(sweeps)) < 0.1))
    check = check_receiver(sweeps.take(is_kept), 0, DECK)
    assert _codes(check) == [(1, "no_sweeps"), (2, "few_sweeps")]
    assert any(text.startswith("order of the photodiodes") for text in check.untested)


def test_photodiodes_that_face_elsewhere_may_receive_less(sweeps: Sweeps) -> None:
    rng = np.random.default_rng(0)
    normal = np.array(DECK.normal)
    normal[1:3] = [1.0, 0.0, 0.0]
    is_kept = (sweeps.sensor != 1) & ((sweeps.sensor != 2) | (rng.random(len(sweeps)) < 0.1))
    check = check_receiver(sweeps.take(is_kept), 0, replace(DECK, normal=normal))
    assert not check.faults
    assert "photodiodes without light (1): turn them to a station" in check.untested


def test_more_photodiodes_than_the_receiver_has(sweeps: Sweeps) -> None:
    three = Receiver(DECK.position_m[:3])
    assert (None, "unknown_photodiodes") in _codes(check_receiver(sweeps, 0, three))


def test_without_a_receiver_the_order_is_untested(sweeps: Sweeps) -> None:
    check = check_receiver(sweeps, 0, None)
    assert not check.faults
    assert any("attach receiver.toml" in text for text in check.untested)


@pytest.mark.slow
def test_a_recorded_tracker(recorded_tracker: Any) -> None:
    """Two of its 22 photodiodes face away from all stations during the recording."""
    ((device, receiver),) = recorded_tracker.receivers.items()
    number = recorded_tracker.sweeps.devices.index(device)
    check = check_receiver(recorded_tracker.sweeps, number, receiver)
    assert not check.faults
    assert check.untested == ("photodiodes without light (8, 13): turn them to a station",)
    exchanged = check_receiver(recorded_tracker.sweeps, number, _exchanged(receiver, 0, 7))
    (fault,) = [fault for fault in exchanged.faults if fault.code == "order"]
    assert "photodiodes 0 and 7 are exchanged" in fault.message
