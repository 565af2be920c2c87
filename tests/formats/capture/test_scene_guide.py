"""Guide through a scene, on sweeps with times of their own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.lighthouse.demodulation.ootx import encode_frame
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene.setup import assign_standstills
from locatk.core.lighthouse.scene.standstills import find_standstills
from locatk.core.lighthouse.simulation.session import SimulationOptions, simulate
from locatk.formats.capture.ingestion import StampedMessage
from locatk.formats.capture.scene_guide import SceneGuide
from locatk.formats.sessions.observations import sweep_messages

S = 10**9


@pytest.fixture(scope="module")
def recorded() -> Sweeps:
    """A robot that is set on four corners of a square for 2 s each, and drives then."""
    return simulate(SimulationOptions(duration_s=30.0, report_hz=40.0, seed=17)).sweeps


def follow(guide: SceneGuide, sweeps: Sweeps, until_s: float = 1e9) -> list[str]:
    """Feed a guide as a recording does, and return what it told."""
    first_ns = int(sweeps.time_ns.min())
    messages = [
        StampedMessage(batch.topic, batch.message.FromString(payload), time_ns, time_ns)
        for stream in sweep_messages(sweeps, batch_ns=20_000_000)
        for batch in stream
        for time_ns, payload in zip(batch.time_ns.tolist(), batch.payloads, strict=True)
    ]
    messages.sort(key=lambda message: message.time_ns)
    lines: list[str] = []
    pending: Iterator[StampedMessage] = iter(messages)
    current = next(pending, None)
    second = 0
    while current is not None and second <= until_s:
        while current is not None and current.publish_ns < first_ns + second * S:
            guide.observe(current)
            current = next(pending, None)
        lines += guide.update(float(second))
        second += 1
        if guide.is_done:
            break
    return lines


def test_the_points_are_recorded_in_order(recorded: Sweeps) -> None:
    guide = SceneGuide(floor_points=2, x_distance_m=1.0, motion_s=5.0)
    lines = follow(guide, recorded)
    assert [line.partition(".")[0] for line in lines if line.startswith("Recorded")] == [
        "Recorded: origin",
        "Recorded: x axis",
        "Recorded: floor",
        "Recorded: floor",
    ]
    assert lines[0].startswith("Waiting")
    assert lines[1].startswith("Put the device at the origin")
    assert "on the x axis, 1 m from the origin" in lines[2]
    assert "Move the device through the whole room for 5 s" in lines[-2]
    assert lines[-1] == "Done."
    assert guide.is_done

    setup = guide.setup(recorded, 1.0, 0.02)
    assert (setup.has_floor, setup.x_distance_m, setup.height_m) == (True, 1.0, 0.02)
    rests = assign_standstills(setup, find_standstills(recorded))
    roles = [each.role for each in rests]
    assert roles[:4] == ["origin", "x axis", "floor", "floor"]
    assert not any(roles[4:])  # Rests during the motion are no points on the floor.
    assert len(roles) > 4


def test_a_rest_is_recorded_once(recorded: Sweeps) -> None:
    """The device stays at the origin for long, and is then put back there."""
    first_ns = int(recorded.time_ns.min())
    at_origin = recorded.take(recorded.time_ns < first_ns + 1.9 * S)
    drive = recorded.take(
        (recorded.time_ns > first_ns + 13.0 * S) & (recorded.time_ns < first_ns + 16.0 * S)
    )

    def later(sweeps: Sweeps, by_s: float) -> Sweeps:
        return replace(sweeps, time_ns=sweeps.time_ns + round(by_s * S))

    parts = [later(at_origin, 1.9 * k) for k in range(6)]
    parts += [later(drive, -1.5)]
    parts += [later(at_origin, 14.8 + 1.9 * k) for k in range(3)]
    names = ("time_ns", "device", "sensor", "channel", "polynomial", "sweep", "count")
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    sweeps = Sweeps(recorded.devices, *columns)
    guide = SceneGuide()
    lines = follow(guide, sweeps)
    assert [point.role for point in guide.accepted] == ["origin"]
    assert sum(line.startswith("This is the position of the origin") for line in lines) == 1


def test_without_light_it_says_so_and_waits(recorded: Sweeps) -> None:
    guide = SceneGuide()
    lines = [line for second in range(25) for line in guide.update(float(second))]
    assert lines[0] == "Waiting for the light of the stations."
    assert [line[:20] for line in lines[1:]] == ["No light is received"] * 2
    assert guide.status == "no light"
    assert not guide.can_finish
    # Light that goes off again is no rest.
    guide = SceneGuide()
    first_ns = int(recorded.time_ns.min())
    follow(guide, recorded.take(recorded.time_ns < first_ns + S))
    for second in range(3, 6):
        guide.update(float(second))
    assert guide.status == "no light"
    assert guide.accepted == []


def test_one_station_is_waited_for_and_then_used(recorded: Sweeps) -> None:
    guide = SceneGuide()
    one = recorded.take(recorded.channel == recorded.channel[0])
    assert len(follow(guide, one, until_s=20)) == 1
    assert "waiting for 2 stations" in guide.status


def test_factory_data_are_shown() -> None:
    """The second robot drives all the time, so that it receives every bit of a frame."""
    bits = encode_frame(bytes(43))
    options = SimulationOptions(duration_s=14.0, report_hz=100.0, robots=2, stations=1, seed=18)
    sweeps = simulate(options).sweeps
    sweeps = sweeps.take(sweeps.device == 1)
    turn = (sweeps.time_ns - 1e9 / 6e6 * sweeps.count) / (959000 / 48e6 * 1e9)
    turn = np.rint(turn - turn.min()).astype(np.int64)
    sweeps = replace(sweeps, polynomial=bits[turn % len(bits)].astype(np.int32))
    guide = SceneGuide()
    follow(guide, sweeps)
    assert guide.status == "stations 1 (factory data); waiting for 2 stations"


def test_a_point_that_is_not_in_the_recording(recorded: Sweeps) -> None:
    guide = SceneGuide(floor_points=0, motion_s=1.0)
    follow(guide, recorded)
    first_ns = int(recorded.time_ns.min())
    with pytest.raises(InputError, match="the rest at the origin is not in the recording"):
        guide.setup(recorded.take(recorded.time_ns > first_ns + 2 * S), None, 0.0)


def test_two_points_in_one_standstill(recorded: Sweeps) -> None:
    guide = SceneGuide(floor_points=0, motion_s=1.0)
    follow(guide, recorded)
    guide.accepted[1] = replace(guide.accepted[0], role=guide.accepted[1].role)
    with pytest.raises(InputError, match="one standstill"):
        guide.setup(recorded, None, 0.0)
