"""Artifact ``receiver.toml``: photodiodes of rigid Lighthouse devices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.formats.artifacts.kinds import InvalidValueError, Text
from locatk.formats.artifacts.schema import (
    Array,
    Artifact,
    Key,
    Table,
    Values,
    refuse_equal_positions,
)

RECEIVER_FILE = "receiver.toml"
"""Name of the attachment that holds the receiver of a session."""

RECEIVER_FORMAT = "locatk-lighthouse-receiver"

MAX_PHOTODIODES = 1_000
"""Photodiodes of one device; the largest on the market have 32."""

NORMAL_LENGTH_TOLERANCE = 1e-3
"""Largest deviation of the length of a direction from 1, for rounded numbers."""


def _receiver_of(values: Values) -> Receiver:
    position, normal = values["position_m"], values["normal"]
    refuse_equal_positions(position, "position_mm")
    if normal is not None:
        if len(normal) != len(position):
            raise InvalidValueError(
                f"expected a list of {len(position)} rows of 3 numbers", "normal"
            )
        with np.errstate(over="ignore"):
            error = np.abs(np.linalg.norm(normal, axis=1) - 1.0)
        if (error > NORMAL_LENGTH_TOLERANCE).any():
            index = int(np.argmax(error > NORMAL_LENGTH_TOLERANCE))
            raise InvalidValueError("expected a direction of length 1", f"normal[{index}]")
    return Receiver(**values)


_ROWS = Array((None, 3), max_rows=MAX_PHOTODIODES)

RECEIVER: Artifact[Receiver] = Artifact(
    RECEIVER_FILE,
    RECEIVER_FORMAT,
    Table(
        (
            Key("name", Text(), "name of the kind of device, for people", ""),
            Key(
                "position_mm",
                _ROWS,
                "x, y, z of each photodiode in the frame of the device, sensor 0 first; no two are "
                "equal",
            ),
            Key(
                "normal",
                _ROWS,
                "optical axis of each photodiode, a direction of length 1 (within 0.001); light "
                "from behind is not received",
                None,
                "unknown",
            ),
        ),
        _receiver_of,
        vars,
    ),
)
"""A receiver as a file."""

dumps_receiver, loads_receiver = RECEIVER.dumps, RECEIVER.loads
write_receiver, read_receiver = RECEIVER.write, RECEIVER.read
attached_receiver, receiver_file = RECEIVER.attached_for, RECEIVER.file_for


def deck_artifacts(stream: Any) -> dict[str, str]:
    """Return the attachment of Bitcraze's Lighthouse deck, which is built in one way only.

    ``locatk capture`` attaches it if no receiver is given. It is empty for other streams.
    """
    is_deck = stream.kind == "lighthouse" and stream.sensors == len(DECK)
    return {RECEIVER_FILE: dumps_receiver(DECK)} if is_deck else {}


def receiver_attachments(receivers: Mapping[str, Receiver], devices: set[str]) -> dict[str, str]:
    """Return attachments (name to text) of ``receivers`` by device.

    It is one file if all ``devices`` of a session have the same receiver, otherwise one a device.

    Raises
    ------
    ArtifactError
        A receiver is invalid: it could not be read again.
    """
    texts = {device: dumps_receiver(receiver) for device, receiver in receivers.items()}
    for device, text in texts.items():
        loads_receiver(text, file=receiver_file(device))
    if texts and set(texts) == devices and len(set(texts.values())) == 1:
        return {RECEIVER_FILE: next(iter(texts.values()))}
    return {receiver_file(device): text for device, text in sorted(texts.items())}
