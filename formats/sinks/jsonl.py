"""Sink ``jsonl:FILE``: one JSON object a line, each complete in the file as soon as it is sent."""

from __future__ import annotations

import os
from typing import IO

from locatk.core.errors import InputError, LocatkError, OutputExistsError, system_hint
from locatk.formats.output import check_output
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import LiveMessage
from locatk.formats.sinks.json_messages import dump, event_to_json
from locatk.formats.sinks.queued import QueuedSink


def create(address: SinkAddress) -> JsonLinesSink:
    """Return the sink of ``jsonl:FILE`` or ``jsonl:FILE?overwrite``."""
    return JsonLinesSink(address)


class JsonLinesSink(QueuedSink):
    """Writes events to a new file; with the option ``overwrite``, an existing one is emptied.

    On a full disk it goes on when there is space. The file never ends within a line.
    """

    def __init__(self, address: SinkAddress) -> None:
        address = address.with_path_options()
        address.reject_unknown_options("overwrite")
        if address.path in ("", "-"):
            raise InputError(
                f"no file in {address.text}",
                hint="Example: jsonl:poses.jsonl. A pipe gets JSON lines without a sink",
            )
        super().__init__(address, address.path)
        self._path = address.path
        self._overwrite = "overwrite" in address.options
        self._file: IO[bytes] | None = None

    def prepare(self) -> None:
        """Create the file.

        Raises
        ------
        OutputExistsError
            It exists, and is not to be overwritten.
        LocatkError
            It cannot be written.
        """
        check_output(self._path, overwrite=True)
        try:
            mode = "wb" if self._overwrite else "xb"
            self._file = open(self._path, mode, buffering=0)  # noqa: SIM115 - open until stop()
        except FileExistsError:
            raise OutputExistsError(
                "output exists",
                file=self._path,
                hint=f"Choose another name or write jsonl:{self._path}?overwrite",
            ) from None
        except OSError as error:
            raise LocatkError(
                f"cannot write: {error.strerror}", file=self._path, hint=system_hint(error)
            ) from error

    def send(self, message: LiveMessage) -> int:
        """Append a line."""
        assert self._file is not None
        line = dump(event_to_json(message.event, message.latency_s())) + b"\n"
        end = self._file.tell()
        try:
            written = self._file.write(line)
            while written < len(line):
                written += self._file.write(line[written:])
        except OSError:
            os.ftruncate(self._file.fileno(), end)
            self._file.seek(end)
            raise
        return 1

    def stop(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
