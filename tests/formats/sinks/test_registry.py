"""Registry of sinks, and their addresses."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from types import ModuleType
from typing import Any

import pytest

from locatk.core.errors import InputError
from locatk.formats.sinks import registry
from locatk.formats.sinks.addresses import parse_address
from locatk.formats.sinks.interface import SinkContext


def add_entry(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    """Have another distribution add a sink."""
    entry = EntryPoint(name, value, registry.ENTRY_POINT_GROUP)

    def entry_points(**selection: Any) -> list[EntryPoint]:
        return [entry] if all(getattr(entry, k) == v for k, v in selection.items()) else []

    monkeypatch.setattr(registry, "entry_points", entry_points)


def test_unknown_sink_names_the_nearest_first(monkeypatch: pytest.MonkeyPatch) -> None:
    add_entry(monkeypatch, "display", "some.module:create")
    with pytest.raises(InputError, match="no sink 'mqt'") as caught:
        registry.create_sink("mqt://host")
    hint = str(caught.value.hint)
    assert hint.startswith("Known sinks: mqtt, ")
    for name in [*registry.SINKS, "display"]:
        assert name in hint


def test_factories_of_this_package_exist() -> None:
    for scheme, rest in [("jsonl", "a.jsonl"), ("udp", "//h:1"), ("mqtts", "//h"), ("zenoh", "")]:
        sink = registry.create_sink(f"{scheme}:{rest}")
        assert sink.address == f"{scheme}:{rest}"
        sink.close(1)


def test_sinks_of_other_packages(monkeypatch: pytest.MonkeyPatch, live: ModuleType) -> None:
    add_entry(monkeypatch, "gated", "sink_helpers:GatedSink")
    sink: Any = registry.create_sink("GATED://host:5")
    assert isinstance(sink, live.GatedSink)
    sink.open(SinkContext("dots"))
    live.offer(sink, live.pose(3))
    sink.close(5)
    assert sink.received[0].position[0] == 3


@pytest.mark.parametrize(
    "value", ["no_such_module:create", "math:no_such_name", "math:pi", "math:sqrt"]
)
def test_broken_sinks_of_other_packages(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    add_entry(monkeypatch, "broken", value)
    with pytest.raises(InputError, match="the sink 'broken'"):
        registry.create_sink("broken:")


@pytest.mark.parametrize(
    ("text", "public"),
    [
        ("mqtt://user:secret@host:1/a", "mqtt://user:***@host:1/a"),
        ("mqtt://user:se@cr/et@host", "mqtt://user:***@host"),
        ("mqtt://:secret@host", "mqtt://:***@host"),
        ("mqtt://user@host:1883", "mqtt://user@host:1883"),
        ("udp://host:9000?format=json", "udp://host:9000?format=json"),
        ("mavlink:udpout:host:1", "mavlink:udpout:host:1"),
    ],
)
def test_passwords_are_masked(text: str, public: str) -> None:
    address = parse_address(text)
    assert address.public_text == public
    assert "secret" not in repr(address)
    with pytest.raises(InputError) as caught:
        registry.create_sink(f"x{text}")
    assert "secret" not in f"{caught.value} {caught.value.hint}"


def test_passwords_are_masked_in_what_is_no_address() -> None:
    with pytest.raises(InputError, match="no address") as caught:
        parse_address("my-mqtt://user:secret@host")
    assert "secret" not in f"{caught.value} {caught.value.hint}"


@pytest.mark.parametrize("text", ["", "udp", "C:/poses.jsonl", "://host", "a b://host"])
def test_what_is_no_address(text: str) -> None:
    with pytest.raises(InputError):
        registry.create_sink(text)


def test_options_of_the_path() -> None:
    address = parse_address("zenoh:?domain=3&topic=a/{device}").with_path_options()
    assert address.path == ""
    assert address.options == {"domain": "3", "topic": "a/{device}"}
    assert address.integer("domain", 0, 0, 232) == 3
    for text in ("-1", "1.5", "233", "", "\u0663"):
        wrong = parse_address(f"zenoh:?domain={text}").with_path_options()
        with pytest.raises(InputError, match="domain="):
            wrong.integer("domain", 0, 0, 232)
