"""Bluetooth devices for tests, in the place of the scanner and the client of bleak."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

import bleak
import pytest

from locatk.formats.capture import bluetooth

WAIT_S = 20.0
"""Longer than anything takes."""


class Peripheral:
    """Device that advertises, accepts a connection, and sends notifications."""

    def __init__(self, name: str | None, address: str, *, has_uart: bool = True) -> None:
        self.name, self.address, self.has_uart = name, address, has_uart
        self.is_on = True
        self.connect_error: Exception | None = None
        self.greeting: tuple[bytes, ...] = ()
        """Notifications sent at each subscription."""
        self.client: FakeClient | None = None
        self.connections = 0
        self.subscribed = threading.Event()

    def send(self, pieces: Iterable[bytes]) -> None:
        """Send notifications, from any thread."""
        assert self.subscribed.wait(WAIT_S)
        client = self.client
        assert client is not None
        for piece in pieces:
            client.loop.call_soon_threadsafe(client.notify, piece)

    def drop(self) -> None:
        """Break the connection after what was sent."""
        client = self.client
        assert client is not None
        self.subscribed.clear()
        client.loop.call_soon_threadsafe(client.lose)


class Air:
    """All devices in range, and the adapter of the computer."""

    def __init__(self) -> None:
        self.devices: list[Peripheral] = []
        self.adapter_error: Exception | None = None
        self.scans = 0

    def add(self, name: str | None, address: str, **more: Any) -> Peripheral:
        self.devices.append(Peripheral(name, address, **more))
        return self.devices[-1]


class FakeScanner:
    """In the place of ``bleak.BleakScanner``."""

    def __init__(self, air: Air) -> None:
        self._air = air

    async def __aenter__(self) -> FakeScanner:
        self._air.scans += 1
        if self._air.adapter_error is not None:
            raise self._air.adapter_error
        return self

    async def __aexit__(self, *error: object) -> None:
        await asyncio.sleep(0)

    @property
    def discovered_devices_and_advertisement_data(self) -> dict[str, tuple[Any, Any]]:
        return {
            each.address: (each, SimpleNamespace(local_name=each.name))
            for each in self._air.devices
            if each.is_on
        }


class FakeClient:
    """In the place of ``bleak.BleakClient``."""

    def __init__(
        self, device: Peripheral, disconnected_callback: Callable[[Any], None], timeout: float
    ) -> None:
        self._device, self._disconnected = device, disconnected_callback
        self._callback: Callable[[Any, bytearray], None] | None = None
        self.is_connected = False

    async def connect(self) -> None:
        self.loop = asyncio.get_running_loop()
        await asyncio.sleep(0)
        if self._device.connect_error is not None:
            raise self._device.connect_error
        self.is_connected = True
        self._device.client = self
        self._device.connections += 1

    @property
    def services(self) -> Any:
        known = {bluetooth.TX_UUID: object()} if self._device.has_uart else {}
        return SimpleNamespace(get_characteristic=known.get)

    async def start_notify(self, uuid: str, callback: Callable[[Any, bytearray], None]) -> None:
        assert uuid == "6e400003-b5a3-f393-e0a9-e50e24dcca9e"
        self._callback = callback
        for piece in self._device.greeting:
            self.notify(piece)
        self._device.subscribed.set()

    def notify(self, piece: bytes) -> None:
        if self.is_connected and self._callback is not None:
            self._callback(None, bytearray(piece))

    def lose(self) -> None:
        if self.is_connected:
            self.is_connected = False
            self._disconnected(self)

    async def disconnect(self) -> None:
        await asyncio.sleep(0)
        self.lose()


def install(monkeypatch: pytest.MonkeyPatch) -> Air:
    """Replace the scanner and the client of bleak; return the devices in range: none yet."""
    air = Air()
    monkeypatch.setattr(bleak, "BleakScanner", lambda: FakeScanner(air))
    monkeypatch.setattr(bleak, "BleakClient", FakeClient)
    monkeypatch.setattr(bluetooth, "SCAN_TIMEOUT_S", 0.1)
    monkeypatch.setattr(bluetooth, "SAME_NAME_WAIT_S", 0.02)
    monkeypatch.setattr(bluetooth, "POLL_INTERVAL_S", 0.005)
    return air
