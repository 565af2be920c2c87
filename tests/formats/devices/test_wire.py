"""The table of devices, and those of other packages."""

from __future__ import annotations

from typing import Any

import pytest

from locatk.core.errors import InputError
from locatk.formats import devices as wire
from locatk.formats.capture.ingestion import SerialIntake
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.devices.interface import Options, Recording
from locatk.formats.devices.lines.decoder import LineDecoder
from locatk.formats.sessions.capture_statistics import CaptureStatistics

MINE = wire.Device("mine", "lines of another package", 9600, f"{__name__}:made")


def made(options: Options) -> LineDecoder:
    return LineDecoder(Options(columns=("a", "b")))


@pytest.fixture
def packages(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Entry points by name: what they hold, or what loading them raises."""
    held: dict[str, Any] = {}

    class Entry:
        def __init__(self, name: str) -> None:
            self.name = self.value = name

        def load(self) -> Any:
            if isinstance(held[self.name], Exception):
                raise held[self.name]
            return held[self.name]

    def entry_points(*, group: str, name: str | None = None) -> list[Entry]:
        assert group == "locatk.devices"
        return [Entry(each) for each in held if name in (None, each)]

    monkeypatch.setattr(wire, "entry_points", entry_points)
    return held


@pytest.mark.parametrize("name", list(wire.DEVICES))
def test_each_device_decodes(name: str) -> None:
    device = wire.find_device(name)
    assert device is wire.DEVICES[name]
    decoder = device.create_decoder(Options())
    assert decoder.feed(b"") == []
    assert decoder.counts.bytes == 0


def test_a_device_of_another_package(
    packages: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    packages["mine"] = MINE
    monkeypatch.setattr(wire, "_load", lambda target: made)
    intake = SerialIntake("red", "", "mine")
    data = b"1,2\n3,4\n5,6\n"
    topics = [each.topic for each in intake.take([ReceivedData(10**18, data, len(data))])]
    assert "/readings/red" in topics
    totals = CaptureStatistics()
    intake.count(totals)
    assert totals.samples["/readings/red"] >= 2


def test_an_unknown_device_is_refused_with_all_that_are_known(packages: dict[str, Any]) -> None:
    packages["mine"] = MINE
    with pytest.raises(InputError, match="no device 'nonsense'") as caught:
        wire.find_device("nonsense")
    assert caught.value.hint is not None
    assert "polaris-array" in caught.value.hint
    assert "mine" in caught.value.hint
    assert caught.value.hint.endswith("auto")


@pytest.mark.parametrize("held", [ModuleNotFoundError("No module named 'gone'"), len])
def test_a_broken_package_is_named(packages: dict[str, Any], held: object) -> None:
    packages["mine"] = held
    with pytest.raises(InputError, match="the device 'mine'"):
        wire.find_device("mine")


def test_a_device_without_an_encoder_says_so() -> None:
    with pytest.raises(InputError, match="no encoder of the device 'raw'"):
        wire.DEVICES["raw"].encode(Recording())
