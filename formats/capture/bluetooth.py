"""Devices that send bytes over Bluetooth Low Energy, by the Nordic UART Service.

The device notifies of changes of one characteristic, and the values of the notifications, 20 to
244 bytes each, are a stream of bytes without boundaries. Source: Nordic Semiconductor, nRF Connect
SDK, Nordic UART Service (NUS),
https://docs.nordicsemi.com/bundle/ncs-latest/page/nrf/libraries/bluetooth/services/nus.html.

The library bleak (extra ``locatk[ble]``) is asynchronous; its event loop runs in a thread for
each connection. bleak is imported when a port is opened.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import sys
import threading
from collections.abc import Mapping
from concurrent.futures import Future, wait
from typing import Any

from locatk.core.printable import escape_controls
from locatk.formats.capture.links import LinkLost, Overruns, SourceError
from locatk.formats.extras import requires_extra

PREFIX = "ble:"

SERVICE_UUID = "6e400001-b5a3-f393-e0a9-e50e24dcca9e"
TX_UUID = "6e400003-b5a3-f393-e0a9-e50e24dcca9e"
"""Characteristic by which the device sends."""

SCAN_TIMEOUT_S = 10.0
"""Longest search for a device; Bluetooth Core 5.4 allows 10.24 s between two advertisements, and
the usual intervals are 0.02 to 2 s."""

SAME_NAME_WAIT_S = 2.0
"""Search after a device of the wanted name was found, for a second one of that name."""

CONNECT_TIMEOUT_S = 10.0

CLOSE_TIMEOUT_S = 2.0
"""Longest wait for the end of a connection; less than :data:`.reader_thread.MAX_STOP_WAIT_S`."""

POLL_INTERVAL_S = 0.05
"""Interval between checks for the end, and of the list of found devices."""

MAX_WAITING_NOTIFICATIONS = 8192
"""Capacity of the queue: 2 MB at 244 bytes, at least 10 s of the fastest connection (2 Mbit/s)."""

MAX_LISTED_NAMES = 12

MAX_REASON_CHARACTERS = 120

OUT_OF_RANGE = "disconnected: out of range, switched off, or closed by the device"


class BluetoothPort:
    """Bluetooth device with the Nordic UART Service.

    After a lost connection, only the device with the same address is opened again, because
    another device may have the same name.

    Parameters
    ----------
    name : str
        ``ble:`` and the name that the device advertises or its address; on macOS, which hides
        addresses, the UUID that stands for it.
    stop : threading.Event, optional
        Ends an attempt to open the port.

    Raises
    ------
    SourceError
        There is no name or address.
    """

    can_reconnect = True

    def __init__(self, name: str, *, stop: threading.Event | None = None) -> None:
        self.name = name
        self._wanted = name[len(PREFIX) :].strip()
        if not self._wanted:
            raise SourceError(
                "no name or address of a device",
                file=name,
                hint="Example: ble:robot7 or ble:C0:11:22:33:44:55",
            )
        self._stop = stop or threading.Event()
        self._cancelled = threading.Event()
        self._device: Any = None

    def open(self) -> BluetoothLink:
        """Find the device and connect to it; see :class:`.links.Port`."""
        with requires_extra("ble", "Bluetooth", file=self.name):
            import bleak  # noqa: F401 - slow to import
        known = None if self._device is None else self._device.address
        link = BluetoothLink(self.name, self._wanted, known)
        try:
            while not wait([link.opened], POLL_INTERVAL_S).done:
                if self._stop.is_set() or self._cancelled.is_set():
                    raise SourceError("stopped before it was connected", file=self.name)
            self._device = link.opened.result()
        except BaseException:
            link.close()
            raise
        return link

    def cancel(self) -> None:
        """End the present attempt to open it, and all later ones."""
        self._cancelled.set()

    def describe(self) -> dict[str, str]:
        """Return ``port``; once it was open, ``resolved``, its address, and ``product``, its name
        if it has one.
        """
        facts = {"port": self.name}
        if self._device is not None:
            facts["resolved"] = self._device.address
            if self._device.name:
                facts["product"] = escape_controls(self._device.name)
        return facts


class BluetoothLink:
    """Connection to a device, in a thread of its own.

    Parameters
    ----------
    port : str
        Name of the port, for errors.
    wanted : str
        Advertised name or address.
    known_address : str, optional
        Address of the only device to accept.

    Attributes
    ----------
    opened : Future
        The device once it is connected, or the SourceError.
    """

    def __init__(self, port: str, wanted: str, known_address: str | None = None) -> None:
        self._port, self._wanted, self._known_address = port, wanted, known_address
        self._notifications: queue.Queue[bytes] = queue.Queue(MAX_WAITING_NOTIFICATIONS)
        self._lost_bytes = 0
        self._disconnected = threading.Event()
        self._closing = threading.Event()
        self.opened: Future[Any] = Future()
        self._thread = threading.Thread(target=self._run, name="locatk-bluetooth", daemon=True)
        self._thread.start()

    def read(self, wait_s: float) -> bytes:
        """Return the bytes that have arrived; see :class:`.links.Link`."""
        # Checked first: all that was received before it is in the queue then.
        ended = self._disconnected.is_set()
        pieces: list[bytes] = []
        with contextlib.suppress(queue.Empty):
            pieces.append(self._notifications.get(timeout=0.0 if ended else max(0.0, wait_s)))
            while len(pieces) < MAX_WAITING_NOTIFICATIONS:
                pieces.append(self._notifications.get_nowait())
        if ended and not pieces:
            raise LinkLost(OUT_OF_RANGE)
        return b"".join(pieces)

    def overruns(self) -> Overruns:
        """Return the number of bytes that arrived while the queue was full."""
        return Overruns(buffer=self._lost_bytes)

    def close(self) -> None:
        """Disconnect, and wait for the end of the thread for a limited time."""
        self._closing.set()
        self._thread.join(CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        try:
            asyncio.run(self._run_until_closed())
        except BaseException as error:
            if not self.opened.done():
                self.opened.set_exception(error)
        finally:
            self._disconnected.set()
            if not self.opened.done():
                self.opened.set_exception(SourceError("not connected", file=self._port))

    async def _run_until_closed(self) -> None:
        connection = asyncio.create_task(self._connect())
        while not (self._closing.is_set() or self._disconnected.is_set() or connection.done()):
            await asyncio.wait([connection], timeout=POLL_INTERVAL_S)
        connection.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await connection

    async def _connect(self) -> None:
        """Connect, and keep the connection until this task is cancelled."""
        import bleak

        try:
            device = await self._find()
        except SourceError:
            raise
        except Exception as error:  # D-Bus and the systems raise errors of many kinds.
            raise _adapter_error(error, self._port) from error
        client = bleak.BleakClient(
            device,
            disconnected_callback=lambda client: self._disconnected.set(),
            timeout=CONNECT_TIMEOUT_S,
        )
        try:
            try:
                await client.connect()
                if client.services.get_characteristic(TX_UUID) is None:
                    raise SourceError(
                        "the device has no Nordic UART Service",
                        file=self._port,
                        hint=f"Its firmware must offer the service {SERVICE_UUID}",
                    )
                await client.start_notify(TX_UUID, self._receive)
            except SourceError:
                raise
            except Exception as error:
                raise _connection_error(error, self._port) from error
            self.opened.set_result(device)
            await asyncio.Event().wait()
        finally:
            with contextlib.suppress(Exception):
                await asyncio.wait_for(client.disconnect(), CLOSE_TIMEOUT_S)

    def _receive(self, characteristic: Any, data: bytearray) -> None:
        if not data:  # An empty read means silence.
            return
        try:
            self._notifications.put_nowait(bytes(data))
        except queue.Full:
            self._lost_bytes += len(data)

    async def _find(self) -> Any:
        """Return the device, as soon as it is certain to be the wanted one."""
        import bleak

        loop = asyncio.get_running_loop()
        end_s = loop.time() + SCAN_TIMEOUT_S
        address = (self._known_address or self._wanted).upper()
        is_named = False
        async with bleak.BleakScanner() as scanner:
            while True:
                found = scanner.discovered_devices_and_advertisement_data
                named = []
                for device, advertisement in found.values():
                    if device.address.upper() == address:
                        return device
                    if self._wanted in (advertisement.local_name, device.name):
                        named.append(device)
                if self._known_address is None and named:
                    if len(named) > 1:
                        raise _ambiguous_error(named, self._port)
                    if not is_named:
                        is_named = True
                        end_s = loop.time() + SAME_NAME_WAIT_S
                    elif loop.time() >= end_s:
                        return named[0]
                elif loop.time() >= end_s:
                    raise _missing_error(found, self._port)
                await asyncio.sleep(POLL_INTERVAL_S)


def _ambiguous_error(devices: list[Any], port: str) -> SourceError:
    addresses = sorted(device.address for device in devices)
    return SourceError(
        f"{len(addresses)} devices have this name: {', '.join(addresses)}",
        file=port,
        hint=f"Give an address: {PREFIX}{addresses[0]}",
    )


def _missing_error(found: Mapping[str, tuple[Any, Any]], port: str) -> SourceError:
    names = {advertisement.local_name or device.name for device, advertisement in found.values()}
    known = sorted(escape_controls(name) for name in names if name)
    text = ", ".join(known[:MAX_LISTED_NAMES]) or "no device with a name"
    if len(known) > MAX_LISTED_NAMES:
        text += f" and {len(known) - MAX_LISTED_NAMES} more"
    return SourceError(
        f"not found in {SCAN_TIMEOUT_S:g} s; found: {text}",
        file=port,
        hint="Check that it is switched on, near, and not connected to a phone or another program",
    )


def _adapter_error(error: Exception, port: str) -> SourceError:
    """Return the error for a computer whose Bluetooth cannot be used."""
    hint = "Switch Bluetooth on in the settings of this computer"
    if sys.platform == "linux":
        hint = "Switch it on: bluetoothctl power on (package bluez, service bluetooth)"
    elif sys.platform == "darwin":
        hint += ", and allow this terminal to use it"
    reason = _reason(error)
    if sys.platform == "linux" and isinstance(error, FileNotFoundError | ConnectionRefusedError):
        reason = "the D-Bus system bus is not running"
    return SourceError(f"Bluetooth is not available ({reason})", file=port, hint=hint)


def _connection_error(error: Exception, port: str) -> SourceError:
    if isinstance(error, TimeoutError):
        problem = f"no answer in {CONNECT_TIMEOUT_S:g} s"
    else:
        problem = f"cannot be connected ({_reason(error)})"
    hint = "Check that it is near, and not connected to a phone or another program"
    return SourceError(problem, file=port, hint=hint)


def _reason(error: Exception) -> str:
    from bleak.exc import BleakBluetoothNotAvailableError

    # Its second argument is a constant for programs.
    text = error.args[0] if isinstance(error, BleakBluetoothNotAvailableError) else error
    return escape_controls(" ".join(str(text).split())[:MAX_REASON_CHARACTERS]) or (
        type(error).__name__
    )
