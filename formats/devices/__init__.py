"""Devices: what comes over the wire from each, as records.

One module a device behind the contract of :mod:`.decoder`; open to others through the
entry-point group ``locatk.devices``, whose entries point to a :class:`Device`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.formats.devices.decoder import Decoder, Options
    from locatk.formats.devices.recording import Recording

GROUP = "locatk.devices"


@dataclass(frozen=True)
class Device:
    """A kind of device, as the user names it.

    Attributes
    ----------
    name : str
    short : str
        What comes over the wire, for the help.
    baud : int
        Of its port, unless the user says otherwise.
    decoder : str
        ``"module:name"`` of a callable that takes :class:`.decoder.Options` and gives a
        :class:`.decoder.Decoder`.
    encoder : str
        ``"module:name"`` of a callable that takes a :class:`.recording.Recording` and
        yields (time in ns, bytes) as the device would send them; ``""`` for none.
    artifacts : str
        ``"module:name"`` of a callable that gives the artifacts to attach where the user
        gives none of the name: a mapping of file name to text, from the sensors of a
        :class:`.decoder.Stream`; ``""`` for none.
    """

    name: str
    short: str
    baud: int
    decoder: str
    encoder: str = ""
    artifacts: str = ""

    def decode(self, options: Options) -> Decoder:
        """A decoder at the start of a stream of bytes."""
        decoder: Decoder = _load(self.decoder)(options)
        return decoder

    def encode(self, recording: Recording) -> Iterator[tuple[int, bytes]]:
        """(time in ns, bytes) of a recording, as the device would send it.

        Raises
        ------
        InputError
            Nobody knows how, or the recording holds nothing that this device sends.
        """
        if not self.encoder:
            raise InputError(f"no encoder of the device {self.name!r}")
        frames: Iterator[tuple[int, bytes]] = _load(self.encoder)(recording)
        return frames

    def attached(self, stream: Any) -> dict[str, str]:
        """Artifacts of a stream that are known without being told."""
        if not self.artifacts:
            return {}
        known: dict[str, str] = _load(self.artifacts)(stream)
        return known


DEVICES = {
    device.name: device
    for device in (
        Device(
            "locatk",
            "frames of the firmware in docs/firmware: COBS, CRC, sequence, ticks",
            115_200,
            "locatk.formats.devices.locatk_frames.decoder:FrameDecoder",
            "locatk.formats.devices.locatk_frames.decoder:encode",
        ),
        Device(
            "polaris-array",
            "published Polaris firmware: 27 or 9 float32 a sample",
            115_200,
            "locatk.formats.devices.float32.arrays:PolarisDecoder",
            "locatk.formats.devices.float32.arrays:encode_polaris",
            "locatk.formats.devices.float32.arrays:polaris_artifacts",
        ),
        Device(
            "magx-array",
            "MagX firmware: 25 float32 a sample",
            115_200,
            "locatk.formats.devices.float32.arrays:MagxDecoder",
            "locatk.formats.devices.float32.arrays:encode_magx",
            "locatk.formats.devices.float32.arrays:magx_artifacts",
        ),
        Device(
            "lighthouse-deck",
            "UART frames of Bitcraze's Lighthouse deck",
            230_400,
            "locatk.formats.devices.lighthouse_deck:DeckDecoder",
            "locatk.formats.devices.lighthouse_deck:encode",
            "locatk.formats.artifacts.receiver:deck_artifacts",
        ),
        Device(
            "dotbot-gateway",
            "HDLC frames of the DotBot gateway with Lighthouse 2 payloads",
            1_000_000,
            "locatk.formats.devices.dotbot_gateway:GatewayDecoder",
            "locatk.formats.devices.dotbot_gateway:encode",
        ),
        Device(
            "lines",
            "lines of text: CSV, name:value",
            115_200,
            "locatk.formats.devices.lines.decoder:LineDecoder",
            "locatk.formats.devices.lines.encoder:encode",
        ),
        Device(
            "raw",
            "bytes that are kept as they are",
            115_200,
            "locatk.formats.devices.raw:RawDecoder",
        ),
    )
}
"""Name to device. ``auto`` is none of them: see :mod:`.identify`."""


def device(name: str) -> Device:
    """The device of this name, of locatk or of another package.

    Raises
    ------
    InputError
        There is none.
    """
    if name in DEVICES:
        return DEVICES[name]
    from importlib.metadata import entry_points

    for entry in entry_points(group=GROUP, name=name):
        try:
            found = entry.load()
        except Exception as error:  # of another package
            raise InputError(f"the device {name!r} cannot be loaded ({error})") from error
        if not isinstance(found, Device):
            raise InputError(f"the device {name!r} of {entry.value} is no Device")
        return found
    others = sorted(entry.name for entry in entry_points(group=GROUP))
    raise InputError(
        f"no device {name!r}", hint=f"Known devices: {', '.join([*DEVICES, *others])}, auto"
    )


def _load(target: str) -> Callable[..., Any]:
    module, _, name = target.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return found
