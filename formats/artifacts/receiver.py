"""Artifact of rigid Lighthouse devices: where the photodiodes sit, ``receiver.toml``.

Its keys are described in docs/formats.md. Lengths are in mm, exactly: what is written and
read again is the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.base import Artifact, head
from locatk.formats.artifacts.checks import twin
from locatk.formats.artifacts.toml import Shifted, Table
from locatk.formats.sessions import capture_record as captured
from locatk.formats.sessions.reader import Session

RECEIVER_FILE = "receiver.toml"
"""Name of the attachment that holds the receiver of a session; see
:func:`attached_receiver`."""

RECEIVER_FORMAT = "locatk-lighthouse-receiver"
VERSION = 1

LARGEST_RECEIVER = 1_000
"""Photodiodes of one device; the largest that are sold have 32."""

UNIT = 1e-3
"""By so much the length of a direction may differ from 1: people round."""

TOPIC = "/lighthouse/"

_MM, _METRES = 3, -3


def dumps_receiver(receiver: Receiver) -> str:
    """TOML text of a receiver; the same receiver gives the same text."""
    normal = receiver.normal
    return toml.dumps(
        {
            **head(RECEIVER_FORMAT, VERSION),
            "name": receiver.name or None,
            "position_mm": Shifted(np.asarray(receiver.position_m, float), _MM),
            "normal": None if normal is None else np.asarray(normal, float),
        }
    )


def _receiver(table: Table) -> Receiver:
    toml.check_format(table, RECEIVER_FORMAT, VERSION)
    rows = table.raw("position_mm")
    count = len(rows) if isinstance(rows, list) else 0
    if not 1 <= count <= LARGEST_RECEIVER:
        raise table.error(
            "position_mm", f"expected x, y, z of 1 to {LARGEST_RECEIVER} photodiodes, a list each"
        )
    position = table.array("position_mm", (count, 3), shift=_METRES)
    if (one := twin(position)) is not None:
        raise table.error("position_mm", f"two photodiodes at the place of photodiode {one}")
    normal = table.array("normal", (count, 3)) if "normal" in table else None
    table.raw("normal", None)  # known also where it is missing
    if normal is not None:
        with np.errstate(over="ignore"):
            off = np.abs(np.linalg.norm(normal, axis=1) - 1.0) > UNIT
        if off.any():
            raise table.error(
                f"normal[{int(np.flatnonzero(off)[0])}]", "expected a direction of length 1"
            )
    receiver = Receiver(position, normal, table.text("name", ""))
    table.end()
    return receiver


RECEIVER = Artifact(RECEIVER_FILE, dumps_receiver, _receiver)
"""A receiver as a file; these are its methods."""

write_receiver, read_receiver, loads_receiver = RECEIVER.write, RECEIVER.read, RECEIVER.loads
attached_receiver, receiver_file = RECEIVER.attached_for, RECEIVER.file_for


def deck_artifacts(stream: Any) -> dict[str, str]:
    """``receiver.toml`` of Bitcraze's Lighthouse deck, which is built in one way only; what
    ``locatk capture`` attaches where nothing else is given."""
    return {RECEIVER_FILE: dumps_receiver(DECK)}


def texts_of(receivers: Mapping[str, Receiver], devices: set[str]) -> dict[str, str]:
    """Attachments (name to text) of ``receivers``: one file where all ``devices`` of a session
    have the same, else one a device.

    Raises
    ------
    ArtifactError
        A receiver cannot be: it could not be read again.
    """
    texts = {device: dumps_receiver(receiver) for device, receiver in receivers.items()}
    for device, text in texts.items():
        loads_receiver(text, file=receiver_file(device))
    if texts and set(texts) == devices and len(set(texts.values())) == 1:
        return {RECEIVER_FILE: next(iter(texts.values()))}
    return {receiver_file(device): text for device, text in sorted(texts.items())}


def read_receivers(session: Session) -> dict[str, Receiver]:
    """Where the photodiodes of each device of a session sit; devices of which nobody tells are
    left out.

    What is attached comes first. A recording of a Lighthouse deck without attachment, as they
    were made before, has the geometry of the deck.

    Raises
    ------
    FormatError, ArtifactError
        An attachment is damaged, or no valid receiver.
    """
    prefix = receiver_file("").removesuffix(".toml")
    devices = {topic.removeprefix(TOPIC) for topic in session.topics(TOPIC)}
    for info in session.attachments():
        if info.name.startswith(prefix) and info.name.endswith(".toml"):
            devices.add(info.name.removeprefix(prefix).removesuffix(".toml"))
    known = DECK if (captured.capture(session) or {}).get("device") == DECK.name else None
    found = {device: attached_receiver(session, device) or known for device in sorted(devices)}
    return {device: receiver for device, receiver in found.items() if receiver is not None}
