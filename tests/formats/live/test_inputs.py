"""Inputs of a live session: what reaches the solver, and what the recorder gets meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts.maps import dumps_halls
from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.links import LinkEnded, LinkLost, Overruns
from locatk.formats.capture.reader_thread import ReceivedData, SourceEnded
from locatk.formats.capture.setup import CaptureRequest, OpenSource, create_intake
from locatk.formats.live import inputs
from locatk.formats.live.inputs import Arrival, ArrivalQueue, InputNotice, LiveInput
from locatk.formats.sessions.observations import read_odometry
from locatk.formats.sessions.reader import Session

LINES = "x_m,y_m,heading_rad\n" + "".join(f"{k}.0,0,0\n" for k in range(5))


class ListedLink:
    """Link that returns the given pieces, one a read."""

    def __init__(self, pieces: list[Any]) -> None:
        self._pieces = iter(pieces)

    def read(self, wait_s: float) -> bytes:
        piece = next(self._pieces, None)
        if piece is None:
            raise LinkEnded("the end")
        if isinstance(piece, Exception):
            raise piece
        return bytes(piece)

    def overruns(self) -> Overruns | None:
        return None

    def close(self) -> None:
        pass


class ListedPort:
    name = "listed"

    def __init__(self, *, can_reconnect: bool = False, later: list[Any] | None = None) -> None:
        self.can_reconnect = can_reconnect
        self._later = later or []

    def open(self) -> ListedLink:
        return ListedLink(self._later)

    def describe(self) -> dict[str, str]:
        return {"resolved": "/dev/again"}


@pytest.fixture
def begin() -> Iterator[Any]:
    """Return a function that starts an input with the given pieces."""
    started: list[LiveInput] = []

    def start(
        pieces: list[Any],
        *,
        port: ListedPort | None = None,
        artifacts: dict[str, str] | None = None,
        **request: Any,
    ) -> tuple[LiveInput, ArrivalQueue]:
        options: dict[str, Any] = {"port": "listed", "device": "lines", "output": None, **request}
        wanted = CaptureRequest(**options)
        source = OpenSource(
            port or ListedPort(), ListedLink(pieces), create_intake(wanted, {}), artifacts or {}
        )
        queue = ArrivalQueue()
        live = LiveInput(0, wanted, source, create_intake(wanted, {}), HostClock(), queue)
        started.append(live)
        live.start(tell=lambda text: None, further=tuple)
        return live, queue

    yield start
    for each in started:
        each.stop_reading()
        each.stop_recording(5.0)


def all_arrivals(queue: ArrivalQueue) -> list[Arrival]:
    """Return the arrivals up to the end of the source."""
    arrivals: list[Arrival] = []
    until = time.monotonic() + 5
    while time.monotonic() < until:
        arrivals += queue.take(0.1)
        if arrivals and isinstance(arrivals[-1].event, SourceEnded):
            return arrivals
    raise AssertionError("the source did not end")


def observations_of(live: LiveInput, queue: ArrivalQueue) -> list[Any]:
    return list(live.decode([each.event for each in all_arrivals(queue)]))


def test_odometry_of_lines(begin: Any) -> None:
    live, queue = begin([LINES[:30].encode(), LINES[30:].encode()], name="red")
    found = [each for each in observations_of(live, queue) if isinstance(each, Trajectory)]
    assert np.concatenate([each.position[:, 0] for each in found]).tolist() == [0, 1, 2, 3, 4]
    assert {each.device for each in found} == {"red"}
    assert live.is_ended
    assert not live.is_connected
    assert live.totals().bytes == len(LINES)


def test_hall_samples_have_the_precision_of_recordings(begin: Any) -> None:
    sensors = HallSensors(range_t=0.0123)
    text = "hall_front_mt,hall_left_mt,hall_rear_mt,hall_right_mt\n1,12.3,-12.3,100\n2,0,0,0\n"
    live, queue = begin([text.encode()], artifacts={"halls.toml": dumps_halls(sensors)})
    found = observations_of(live, queue)
    field = np.concatenate([each.field_t for each in found if isinstance(each, HallSamples)])
    assert field[0, 0] == np.float32(0.001)
    # A saturated reading stays at the range although float32 rounds it.
    assert field[0, 1] == 0.0123
    assert field[0, 2] == -0.0123


def test_sensors_without_geometry_are_an_error_with_a_remedy(begin: Any) -> None:
    live, queue = begin(
        [b"hall_front_mt,hall_left_mt,hall_rear_mt,hall_right_mt\n1,0,0,0\n1,0,0,0\n"]
    )
    with pytest.raises(InputError, match="no geometry") as error:
        observations_of(live, queue)
    assert "halls.toml" in str(error.value.hint)


def test_a_lost_connection_is_a_notice(begin: Any) -> None:
    port = ListedPort(can_reconnect=True, later=[LINES.encode()])
    live, queue = begin([LINES[:25].encode(), LinkLost("unplugged")], port=port)
    notices = [each for each in observations_of(live, queue) if isinstance(each, InputNotice)]
    texts = [each.text for each in notices]
    assert any("connection lost: unplugged" in text for text in texts)
    assert any("reconnected to /dev/again" in text for text in texts)


def test_a_recorded_file_waits_for_the_solver(begin: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inputs, "MAX_WAITING_BYTES", 100)
    live, queue = begin([b"x" * 80] * 20)
    time.sleep(0.1)
    assert live.waiting_bytes <= 180
    taken = 0
    until = time.monotonic() + 5
    while not live.is_ended and time.monotonic() < until:
        events = [each.event for each in queue.take(0.1)]
        taken += sum(each.size for each in events if isinstance(each, ReceivedData))
        list(live.decode(events))
    assert taken == 20 * 80
    assert live.dropped_bytes == 0


def test_bytes_of_a_device_are_left_out_if_the_solver_is_late(
    begin: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inputs, "MAX_WAITING_BYTES", 100)
    port = ListedPort(can_reconnect=True)
    release = threading.Event()

    class Slow(ListedLink):
        def read(self, wait_s: float) -> bytes:
            data = super().read(wait_s)
            if data == b"late\n":
                release.wait(5)
            return data

    wanted = CaptureRequest("listed", "lines", None)
    source = OpenSource(port, Slow([b"x" * 80] * 5 + [b"late\n"]), create_intake(wanted, {}), {})
    queue = ArrivalQueue()
    live = LiveInput(0, wanted, source, create_intake(wanted, {}), HostClock(), queue)
    live.start(tell=lambda text: None, further=tuple)
    until = time.monotonic() + 5
    while live.dropped_bytes < 320 and time.monotonic() < until:
        time.sleep(0.01)
    assert live.dropped_bytes == 4 * 80
    list(live.decode([each.event for each in queue.take(0.1)]))
    release.set()
    notices: list[str] = []
    while not notices and time.monotonic() < until:
        for each in live.decode([each.event for each in queue.take(0.1)]):
            if isinstance(each, InputNotice):
                notices.append(each.text)
    assert "the solver was late" in notices[0]
    live.stop_reading()


def test_the_recording_has_every_byte_and_the_further_messages(begin: Any, tmp_path: Path) -> None:
    output = tmp_path / "run.mcap"
    live, queue = begin([LINES.encode()] * 3, output=output)
    observations_of(live, queue)
    live.stop_reading()
    live.stop_recording(5.0)
    assert live.recording is not None
    assert not live.recording.failed
    session = Session.open(output)
    (odometry,) = read_odometry(session)
    assert odometry.position[:, 0].tolist() == [0, 1, 2, 3, 4] * 3
    assert live.recording.totals.bytes == 3 * len(LINES)


def test_the_solver_goes_on_when_the_recording_fails(begin: Any, tmp_path: Path) -> None:
    output = tmp_path / "run.mcap"
    told: list[str] = []
    wanted = CaptureRequest("listed", "lines", output)
    source = OpenSource(
        ListedPort(), ListedLink([LINES.encode()] * 3), create_intake(wanted, {}), {}
    )
    queue = ArrivalQueue()
    live = LiveInput(0, wanted, source, create_intake(wanted, {}), HostClock(), queue)

    def broken() -> Any:
        raise OSError("no space left on device")

    live.start(tell=told.append, further=broken)
    found = [each for each in observations_of(live, queue) if isinstance(each, Trajectory)]
    assert sum(map(len, found)) == 15
    live.stop_reading()
    live.stop_recording(5.0)
    assert not live.is_recording
    assert any("no space left" in text for text in told)
