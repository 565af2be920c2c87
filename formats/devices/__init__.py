"""Registry of the devices whose bytes locatk decodes, and sends when it emulates them.

Each device is a module or package behind the contract of :mod:`.decoder`. Other distributions add
devices through the entry-point group ``locatk.devices``, whose entries point to a :class:`Device`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any

from locatk.core.errors import InputError
from locatk.formats.devices.interface import Decoder, Options, Recording, Stream

ENTRY_POINT_GROUP = "locatk.devices"


@dataclass(frozen=True)
class Device:
    """Kind of device, with the callables that decode and encode its bytes.

    Attributes
    ----------
    name : str
        Value of ``--device``.
    summary : str
        Format of its bytes, in one line.
    baud : int
        Baud rate of its port, unless the user gives another one.
    decoder : str
        ``"module:name"`` of a callable that takes :class:`.decoder.Options` and returns a
        :class:`.decoder.Decoder`.
    encoder : str
        ``"module:name"`` of a callable that takes a :class:`.decoder.Recording` and yields
        (time in ns, bytes) as the device would send them; ``""`` if there is none.
    artifacts : str
        ``"module:name"`` of a callable that takes a :class:`.decoder.Stream` and returns
        artifacts (file name to text) that are attached if the user gives none of that name;
        ``""`` if there is none.
    """

    name: str
    summary: str
    baud: int
    decoder: str
    encoder: str = ""
    artifacts: str = ""

    def create_decoder(self, options: Options) -> Decoder:
        """Return a decoder at the start of a byte stream."""
        decoder: Decoder = _load(self.decoder)(options)
        return decoder

    def encode(self, recording: Recording) -> Iterator[tuple[int, bytes]]:
        """Return (time in ns, bytes) of a recording, as the device would send it.

        Raises
        ------
        InputError
            The device has no encoder, or the recording contains nothing that it sends.
        """
        if not self.encoder:
            raise InputError(f"no encoder of the device {self.name!r}")
        frames: Iterator[tuple[int, bytes]] = _load(self.encoder)(recording)
        return frames

    def default_artifacts(self, stream: Stream) -> dict[str, str]:
        """Return the artifacts of a stream that follow from the device: file name to text."""
        if not self.artifacts:
            return {}
        artifacts: dict[str, str] = _load(self.artifacts)(stream)
        return artifacts


DEVICES = {
    device.name: device
    for device in (
        Device(
            "locatk",
            "frames of the firmware in docs/firmware: COBS, CRC, sequence number, ticks",
            115_200,
            "locatk.formats.devices.locatk_frames.decoder:FrameDecoder",
            "locatk.formats.devices.locatk_frames.decoder:encode",
            "locatk.formats.artifacts.receiver:deck_artifacts",
        ),
        Device(
            "polaris-array",
            "published Polaris firmware: 27 or 9 float32 per sample",
            115_200,
            "locatk.formats.devices.float32.decoder:PolarisDecoder",
            "locatk.formats.devices.float32.decoder:encode_polaris",
            "locatk.formats.devices.float32.decoder:polaris_artifacts",
        ),
        Device(
            "magx-array",
            "MagX firmware: 25 float32 per sample",
            115_200,
            "locatk.formats.devices.float32.decoder:MagxDecoder",
            "locatk.formats.devices.float32.decoder:encode_magx",
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
            "any bytes, stored without decoding",
            115_200,
            "locatk.formats.devices.raw:RawDecoder",
        ),
    )
}
"""Built-in devices by name. ``auto`` is not a device: see :mod:`.identification`."""


def find_device(name: str) -> Device:
    """Return the device of this name, built in or of another package.

    Raises
    ------
    InputError
        There is no such device, or it cannot be loaded.
    """
    if name in DEVICES:
        return DEVICES[name]
    for entry in entry_points(group=ENTRY_POINT_GROUP, name=name):
        try:
            device = entry.load()
        except Exception as error:  # Code of another package may raise anything.
            raise InputError(f"the device {name!r} cannot be loaded ({error})") from error
        if not isinstance(device, Device):
            raise InputError(f"the device {name!r} of {entry.value} is not a Device")
        return device
    others = sorted(entry.name for entry in entry_points(group=ENTRY_POINT_GROUP))
    raise InputError(
        f"no device {name!r}", hint=f"Known devices: {', '.join([*DEVICES, *others])}, auto"
    )


def _load(target: str) -> Callable[..., Any]:
    module, _, name = target.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function
