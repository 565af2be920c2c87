"""A device on a port, read by a thread as a program would: what arrives, and what is counted."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from locatk.core.errors import InputError, OutputExistsError
from locatk.formats.emulation.byte_stream import (
    ConstantRate,
    LineFaults,
    RecordedPace,
    repeat_packets,
)
from locatk.formats.emulation.emulator import EmulationCounts, EmulationPlan, Emulator
from locatk.formats.emulation.pseudo_terminal import PseudoPort

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="pseudo-terminals of Linux")

SETTLE_S = 0.03
QUICK = {"settle_s": SETTLE_S}
IMPATIENT = {**QUICK, "max_blocked_s": 0.1, "end_wait_s": 0.2}


def numbered(count: int, step_ms: float = 1.0, size: int = 8) -> list[tuple[int, bytes]]:
    """Packets of which each tells its number, ``step_ms`` apart."""
    return [(int(k * step_ms * 1e6), k.to_bytes(size, "big")) for k in range(count)]


def joined(packets: list[tuple[int, bytes]]) -> bytes:
    return b"".join(data for _, data in packets)


def balanced(totals: EmulationCounts) -> bool:
    lost = totals.dropped + totals.unheard + totals.overrun
    return totals.made == totals.sent + lost


class Reader(threading.Thread):
    """Opens the port as often as it comes, and reads what arrives until it goes.

    Parameters
    ----------
    path : str
    delay_s : float
        Before the port is opened for the first time.
    first : callable, optional
        Called with the descriptor when it was opened for the first time.
    leaves_after : int, optional
        Bytes after which it closes the port, once, and stays away for a tenth of a second.
    """

    def __init__(
        self,
        path: str,
        delay_s: float = 0.0,
        first: Callable[[int], None] | None = None,
        leaves_after: int | None = None,
    ) -> None:
        super().__init__(daemon=True)
        self.path, self.delay_s, self.first, self.leaves_after = path, delay_s, first, leaves_after
        self.parts: list[bytes] = []
        self.over = threading.Event()

    @property
    def data(self) -> bytes:
        return b"".join(self.parts)

    def run(self) -> None:
        time.sleep(self.delay_s)
        while not self.over.is_set():
            try:
                port = os.open(self.path, os.O_RDONLY | os.O_NOCTTY)
            except OSError:
                time.sleep(0.002)
                continue
            self.parts.append(b"")
            if self.first and len(self.parts) == 1:
                self.first(port)
            leaves = self.read(port)
            os.close(port)
            if leaves:
                time.sleep(0.1)

    def read(self, port: int) -> bool:
        """Until the port is gone, or the reader leaves."""
        try:
            while piece := os.read(port, 100 if self.leaves_after else 65_536):
                self.parts[-1] += piece
                if self.leaves_after and len(self.data) >= self.leaves_after:
                    self.leaves_after = None
                    time.sleep(0.03)  # something arrives that it does not read
                    return True
        except OSError:
            pass
        return False

    def finish(self) -> None:
        self.over.set()
        self.join(10)
        assert not self.is_alive()


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PseudoPort]:
    made = PseudoPort(tmp_path / "port")
    yield made
    made.close()
    assert list(tmp_path.iterdir()) == []


def emulate(emulator: Emulator, *readers: Reader) -> EmulationCounts:
    """Run to the end with readers at work."""
    for reader in readers:
        reader.start()
    emulator.run()
    for reader in readers:
        reader.finish()
    assert balanced(emulator.totals)
    return emulator.totals


@pytest.mark.slow
def test_every_byte_arrives_in_order(port: PseudoPort) -> None:
    packets = numbered(2000, step_ms=0.1, size=64)
    reader = Reader(port.path)
    start = time.monotonic()
    totals = emulate(Emulator(port, RecordedPace(packets), plan=EmulationPlan(**QUICK)), reader)
    assert reader.data == joined(packets)
    assert totals == EmulationCounts(made=len(reader.data), sent=len(reader.data))
    assert time.monotonic() - start > 0.2, "not before it is due"


def test_more_than_a_terminal_holds_at_once(port: PseudoPort) -> None:
    data = np.random.default_rng(3).bytes(300_000)
    reader = Reader(port.path)
    emulate(Emulator(port, RecordedPace([(0, data)]), plan=EmulationPlan(**QUICK)), reader)
    assert reader.data == data


@pytest.mark.slow
def test_a_constant_rate(port: PseudoPort) -> None:
    data = np.random.default_rng(3).bytes(200_000)
    reader = Reader(port.path)
    start = time.monotonic()
    emulate(Emulator(port, ConstantRate([(0, data)], 1e6), plan=EmulationPlan(**QUICK)), reader)
    assert reader.data == data
    assert time.monotonic() - start > 0.2


def test_a_late_reader_misses_nothing(port: PseudoPort) -> None:
    packets = numbered(100, step_ms=0.2)
    reader = Reader(port.path, delay_s=0.15)
    emulate(Emulator(port, RecordedPace(packets), plan=EmulationPlan(**QUICK)), reader)
    assert reader.data == joined(packets)


def test_the_first_reader_may_throw_away_what_is_there_when_it_opens(port: PseudoPort) -> None:
    """As pyserial does, shortly after it opened the port."""
    import termios

    def flush(descriptor: int) -> None:
        time.sleep(SETTLE_S / 2)
        termios.tcflush(descriptor, termios.TCIFLUSH)

    packets = numbered(100, step_ms=0.2)
    reader = Reader(port.path, first=flush)
    emulate(
        Emulator(port, RecordedPace(packets), plan=EmulationPlan(settle_s=6 * SETTLE_S)), reader
    )
    assert reader.data == joined(packets)


@pytest.mark.slow
def test_a_passer_by_does_not_start_it(port: PseudoPort) -> None:
    """As ``stty -F PORT`` before the reader."""
    packets = numbered(50)
    emulator = Emulator(port, RecordedPace(packets), plan=EmulationPlan(settle_s=0.1))
    run = threading.Thread(target=emulator.run)
    run.start()
    os.close(os.open(port.path, os.O_RDWR | os.O_NOCTTY))
    time.sleep(0.15)
    assert emulator.totals.made == 0
    reader = Reader(port.path)
    reader.start()
    run.join(10)
    reader.finish()
    assert reader.data == joined(packets)


@pytest.mark.slow
def test_without_waiting_the_start_is_lost(port: PseudoPort) -> None:
    packets = numbered(250)
    reader = Reader(port.path, delay_s=0.1)
    totals = emulate(
        Emulator(port, RecordedPace(packets), plan=EmulationPlan(wait=False, **QUICK)), reader
    )
    assert joined(packets).endswith(reader.data)
    assert totals.sent == len(reader.data) > 0
    assert totals.unheard == totals.made - totals.sent > 0


def test_without_any_reader_all_is_lost(port: PseudoPort) -> None:
    totals = emulate(
        Emulator(port, RecordedPace(numbered(50)), plan=EmulationPlan(wait=False, **QUICK))
    )
    assert totals == EmulationCounts(made=400, unheard=400)


@pytest.mark.slow
def test_while_the_reader_is_away_bytes_are_lost_and_counted(port: PseudoPort) -> None:
    """Among them what it left unread: the next reader does not get to see it."""
    packets = numbered(350)
    reader = Reader(port.path, leaves_after=400)
    totals = emulate(Emulator(port, RecordedPace(packets), plan=EmulationPlan(**QUICK)), reader)
    before, after = reader.parts
    assert joined(packets).startswith(before)
    assert joined(packets).endswith(after)
    assert totals.sent == len(reader.data)
    assert totals.unheard == totals.made - totals.sent > 0


@pytest.mark.slow
def test_a_reader_that_does_not_read_loses_bytes_in_the_middle(port: PseudoPort) -> None:
    packets = numbered(500, size=200)  # 100 kB, where a terminal holds 20 kB
    reader = Reader(port.path, first=lambda descriptor: time.sleep(0.3))
    totals = emulate(Emulator(port, RecordedPace(packets), plan=EmulationPlan(**IMPATIENT)), reader)
    assert totals.sent == len(reader.data)
    assert totals.overrun == totals.made - totals.sent > 10_000
    whole = joined(packets)
    same = next(
        (k for k, (a, b) in enumerate(zip(whole, reader.data, strict=False)) if a != b),
        len(reader.data),
    )
    assert same > 10_000, "what the terminal held"
    assert whole.endswith(reader.data[-200:]), "it catches up"


@pytest.mark.slow
def test_a_busy_reader_loses_nothing(port: PseudoPort) -> None:
    packets = numbered(250, size=200)
    reader = Reader(port.path, first=lambda descriptor: time.sleep(0.2))
    emulate(Emulator(port, RecordedPace(packets), plan=EmulationPlan(**QUICK)), reader)
    assert reader.data == joined(packets)


@pytest.mark.slow
def test_as_fast_as_the_reader_takes_it_nothing_is_lost(port: PseudoPort) -> None:
    """Neither while it is busy nor while it is away, but for what it left unread."""
    packets = numbered(6000, step_ms=1000, size=200)
    busy = Reader(port.path, first=lambda descriptor: time.sleep(0.3), leaves_after=60_000)
    pace = RecordedPace(packets, float("inf"))
    totals = emulate(Emulator(port, pace, plan=EmulationPlan(lossless=True, **QUICK)), busy)
    before, after = busy.parts
    assert joined(packets).startswith(before)
    assert joined(packets).endswith(after)
    assert totals.made == 1_200_000
    assert totals.sent == len(busy.data)
    assert totals.unheard < 25_000, "at most what it did not read before it left"
    assert totals.overrun == 0


@pytest.mark.slow
def test_unplugging(port: PseudoPort) -> None:
    packets = numbered(580)
    reader = Reader(port.path)
    plan = EmulationPlan(unplug_every_s=0.15, away_s=0.1, **QUICK)
    totals = emulate(Emulator(port, RecordedPace(packets), plan=plan), reader)
    assert totals.unplugs == 2
    assert len(reader.parts) == 3
    assert totals.sent == len(reader.data)
    assert totals.unheard == totals.made - totals.sent >= 2 * 8 * 100
    whole = joined(packets)
    places = [whole.find(part) for part in reader.parts]
    assert places[0] == 0, "from the start"
    assert min(places) >= 0, "what arrives is one piece of the stream"
    assert places == sorted(places)
    missing = [
        after - before - len(part)
        for before, after, part in zip(places[:-1], places[1:], reader.parts[:-1], strict=True)
    ]
    assert sum(missing) + len(whole) - places[-1] - len(reader.parts[-1]) == totals.unheard
    assert min(missing) >= 8 * 100


@pytest.mark.slow
def test_a_reader_that_is_cut_off_knows_what_it_missed(port: PseudoPort) -> None:
    """What it had not read when the port went is counted to the byte."""
    packets = numbered(250)
    reader = Reader(port.path, first=lambda descriptor: reader.over.wait(9))
    plan = EmulationPlan(unplug_every_s=0.15, away_s=9, **QUICK)
    totals = emulate(Emulator(port, RecordedPace(packets), plan=plan), reader)
    assert reader.data == b""
    assert totals == EmulationCounts(made=2000, unheard=2000, unplugs=1)


def test_a_port_that_cannot_come_back(port: PseudoPort) -> None:
    plan = EmulationPlan(wait=False, unplug_every_s=0.05, away_s=0.1, **QUICK)
    taken = Path(port.path)
    threading.Timer(0.1, taken.write_text, ["precious"]).start()
    with pytest.raises(OutputExistsError):
        Emulator(port, RecordedPace(numbered(1000)), plan=plan).run()
    assert taken.read_text() == "precious"
    taken.unlink()


@pytest.mark.slow
def test_the_last_bytes_are_waited_for(port: PseudoPort) -> None:
    def slowly(descriptor: int) -> None:
        time.sleep(0.2)
        while True:
            piece = os.read(descriptor, 100)
            reader.parts[-1] += piece
            if len(reader.parts[-1]) >= 8000:
                return
            time.sleep(0.001)

    packets = numbered(1000, step_ms=0.01)
    reader = Reader(port.path, first=slowly)
    emulate(Emulator(port, RecordedPace(packets), plan=EmulationPlan(**QUICK)), reader)
    assert reader.data == joined(packets)


@pytest.mark.slow
def test_the_last_bytes_are_not_waited_for_for_ever(port: PseudoPort) -> None:
    reader = Reader(port.path, first=lambda descriptor: reader.over.wait(9))
    totals = emulate(
        Emulator(port, RecordedPace(numbered(100, step_ms=0.1)), plan=EmulationPlan(**IMPATIENT)),
        reader,
    )
    assert totals == EmulationCounts(made=800, unheard=800)


def test_faults_are_counted_as_they_arrive(port: PseudoPort) -> None:
    packets = numbered(4000, step_ms=0.02, size=50)
    reader = Reader(port.path)
    emulator = Emulator(
        port, RecordedPace(packets), LineFaults(0.01, 0.002, seed=5), EmulationPlan(**QUICK)
    )
    totals = emulate(emulator, reader)
    expected = LineFaults(0.01, 0.002, seed=5)
    assert reader.data == expected.apply(joined(packets))
    assert (totals.dropped, totals.flipped) == (expected.dropped, expected.flipped)
    assert totals.dropped > 0
    assert totals.sent == len(reader.data)


def test_again_and_again(port: PseudoPort) -> None:
    packets = numbered(100, step_ms=0.2)
    reader = Reader(port.path)
    emulate(
        Emulator(
            port, RecordedPace(repeat_packets(lambda: packets, 3)), plan=EmulationPlan(**QUICK)
        ),
        reader,
    )
    assert reader.data == 3 * joined(packets)


def test_a_failing_source_leaves_nothing_behind(port: PseudoPort) -> None:
    """The port is gone, and what was sent is counted."""

    def packets() -> Iterator[tuple[int, bytes]]:
        yield from numbered(100)
        raise InputError("damaged")

    reader = Reader(port.path)
    reader.start()
    emulator = Emulator(port, RecordedPace(packets()), plan=EmulationPlan(**QUICK))
    with pytest.raises(InputError):
        emulator.run()
    reader.finish()
    assert not os.path.lexists(port.path)
    assert balanced(emulator.totals)
    assert emulator.totals.sent == len(reader.data) > 0


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1.0, float("inf")])
def test_it_can_be_stopped_while_it_sends(port: PseudoPort, speed: float) -> None:
    packets = [(1_000_000 * k, bytes([k % 256]) * 100) for k in range(100_000)]
    reader = Reader(port.path)
    plan = EmulationPlan(lossless=speed > 1, **QUICK)
    emulator = Emulator(port, RecordedPace(packets, speed), plan=plan)
    threading.Timer(0.15, emulator.stop).start()
    totals = emulate(emulator, reader)
    assert joined(packets).startswith(reader.data)
    assert totals.sent == len(reader.data) > 0
    assert totals.made < 10_000_000


@pytest.mark.slow
def test_it_can_be_stopped_while_it_waits(port: PseudoPort) -> None:
    """For the first reader, and for the last one to read."""
    emulator = Emulator(port, RecordedPace(numbered(10)), plan=EmulationPlan(**QUICK))
    threading.Timer(0.05, emulator.stop).start()
    assert emulate(emulator) == EmulationCounts()

    port.plug()
    reader = Reader(port.path, first=lambda descriptor: reader.over.wait(9))
    emulator = Emulator(
        port, RecordedPace(numbered(10)), plan=EmulationPlan(lossless=True, **QUICK)
    )
    threading.Timer(0.2, emulator.stop).start()
    assert emulate(emulator, reader) == EmulationCounts(made=80, unheard=80)


@pytest.mark.slow
def test_a_standing_device_costs_little(port: PseudoPort) -> None:
    """It does not spin while nothing is due: a tenth of a core at the very most."""
    reader = Reader(port.path)
    packets = [(0, b"start"), (250_000_000, b"end")]
    before = time.process_time()
    emulate(Emulator(port, RecordedPace(packets), plan=EmulationPlan(**QUICK)), reader)
    assert time.process_time() - before < 0.2
    assert reader.data == b"startend"
