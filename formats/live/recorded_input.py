"""Recording of an input whose bytes the solver decodes: they are decoded only once."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

from locatk.formats.capture.ingestion import (
    SerialIntake,
    StampedMessage,
    TimedBatch,
    pack_records,
)
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.sessions.capture_statistics import CaptureStatistics


class RecordedInput:
    """Intake of a recorder (:class:`.ingestion.Intake`) with the records of the solver's decoder.

    Raw bytes come from the reader and are recorded whatever the solver does. Its records follow
    when it has decoded them. :meth:`add` runs in the thread of the solver, all other methods in
    that of the recorder.

    Parameters
    ----------
    raw : SerialIntake
        Makes the messages of raw bytes; it decodes nothing.
    decoder : SerialIntake
        That of the solver, for statistics.

    Attributes
    ----------
    device_artifacts : dict of str to str
        Artifacts that follow from the device, set by the solver; name to text.
    """

    def __init__(self, raw: SerialIntake, decoder: SerialIntake) -> None:
        self._raw, self._decoder = raw, decoder
        self._records: deque[TimedBatch] = deque()
        self.declared = raw.declared
        self.device_artifacts: dict[str, str] = {}

    @property
    def system(self) -> str:
        """System of the session, ``""`` while it is unknown."""
        return self._decoder.system

    @property
    def device(self) -> object:
        """Device of the decoder; None while it is unknown."""
        return self._decoder.device

    def add(self, records: Sequence[TimedBatch]) -> None:
        """Add records that the solver has decoded."""
        self._records.extend(records)

    def take(self, arrived: Sequence[ReceivedData]) -> Iterator[StampedMessage]:
        """Return the messages of received data."""
        return self._raw.chunks(arrived)

    def turn(self, now_ns: int) -> Iterator[StampedMessage]:
        """Return the messages of the records that were decoded meanwhile."""
        for _ in range(len(self._records)):
            yield from pack_records(self._records.popleft())

    def restart(self) -> Iterator[StampedMessage]:
        """Mark the next bytes as the first ones after a reconnect."""
        self._raw.mark_opened()
        return iter(())

    def finish(self) -> Iterator[StampedMessage]:
        """Return the messages of the last records."""
        return self.turn(0)

    def count(self, totals: CaptureStatistics) -> None:
        """Write the counts of the decoder, and the recorded bytes, into ``totals``."""
        self._decoder.count(totals)
        raw = CaptureStatistics()
        self._raw.count(raw)
        totals.bytes = raw.bytes

    def remarks(self) -> list[str]:
        """Return nothing: the session reports the remarks of the decoder."""
        return []

    def clocks(self) -> dict[str, str]:
        """Return the parameters of the devices' clocks."""
        return self._decoder.clocks()

    def rates(self) -> dict[str, float]:
        """Return decoded records per second by topic."""
        return self._decoder.rates()

    def artifacts(self) -> dict[str, str]:
        """Return the artifacts that follow from the device."""
        return dict(self.device_artifacts)
