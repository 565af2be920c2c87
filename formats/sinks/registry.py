"""Registry of the sinks of ``locatk live``, by the scheme of their address.

Other distributions add sinks through the entry-point group ``locatk.sinks``: the name of an entry
is the scheme, and it points to a callable that takes a :class:`.addresses.SinkAddress` and returns
a :class:`.interface.Sink`.
"""

from __future__ import annotations

import difflib
import importlib
from importlib.metadata import entry_points

from locatk.core.errors import InputError, LocatkError
from locatk.formats.sinks.addresses import SinkAddress, parse_address
from locatk.formats.sinks.interface import Sink

ENTRY_POINT_GROUP = "locatk.sinks"

SINKS = {
    "web": ("locatk.formats.sinks.web.sink:create", "page in a browser: map, paths, latency"),
    "foxglove": ("locatk.formats.sinks.foxglove:create", "server for Foxglove and Lichtblick"),
    "jsonl": ("locatk.formats.sinks.jsonl:create", "file with one JSON object a line"),
    "udp": ("locatk.formats.sinks.udp:create", "datagrams, JSON or packed"),
    "mqtt": ("locatk.formats.sinks.mqtt:create", "MQTT broker: JSON or VDA 5050"),
    "mqtts": ("locatk.formats.sinks.mqtt:create", "MQTT broker over TLS"),
    "zenoh": ("locatk.formats.sinks.zenoh:create", "ROS 2 over zenoh, without ROS here"),
    "ros2": ("locatk.formats.sinks.ros2:create", "ROS 2 where its Python packages are sourced"),
    "mavlink": ("locatk.formats.sinks.mavlink:create", "PX4 or ArduPilot: ODOMETRY"),
}
"""Built-in sinks: scheme to (``"module:factory"``, summary)."""


def create_sink(text: str) -> Sink:
    """Return the sink of an address, not yet open.

    Raises
    ------
    InputError
        The address is invalid, or there is no such sink.
    """
    address = parse_address(text)
    if address.scheme in SINKS:
        module, _, name = SINKS[address.scheme][0].partition(":")
        sink: Sink = getattr(importlib.import_module(module), name)(address)
        return sink
    for entry in entry_points(group=ENTRY_POINT_GROUP, name=address.scheme):
        try:
            factory = entry.load()
        except Exception as error:  # Code of another package may raise anything.
            raise InputError(
                f"the sink {address.scheme!r} cannot be loaded ({error})",
                hint=f"Update the package of {entry.value}",
            ) from error
        return _create_foreign(factory, address)
    raise InputError(
        f"no sink {address.scheme!r}", hint=f"Known sinks: {', '.join(_nearest(address.scheme))}"
    )


def sink_summaries() -> dict[str, str]:
    """Return the receiver of each sink by scheme, those of other packages included."""
    foreign = {entry.name: entry.value for entry in entry_points(group=ENTRY_POINT_GROUP)}
    return {**foreign, **{scheme: summary for scheme, (_, summary) in SINKS.items()}}


def _create_foreign(factory: object, address: SinkAddress) -> Sink:
    if not callable(factory):
        raise InputError(f"the sink {address.scheme!r} is not callable")
    try:
        sink: Sink = factory(address)
    except LocatkError:
        raise
    except Exception as error:  # Code of another package may raise anything.
        raise InputError(
            f"the sink {address.scheme!r} cannot be created ({error})",
            hint="Check its address, or update its package",
        ) from error
    return sink


def _nearest(scheme: str) -> list[str]:
    """Return the known schemes, the most similar ones first."""
    names = [*SINKS, *sorted(entry.name for entry in entry_points(group=ENTRY_POINT_GROUP))]
    similar = difflib.get_close_matches(scheme, names)
    return similar + [name for name in names if name not in similar]
