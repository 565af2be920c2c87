"""docs/live_messages.md: its example runs, its tables name what the code sends."""

from __future__ import annotations

import os
import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from locatk.formats.sinks import registry
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.json_messages import event_to_json
from locatk.formats.sinks.udp import PACKED


@pytest.fixture
def page(root: Path) -> str:
    return (root / "docs" / "live_messages.md").read_text(encoding="utf-8")


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals")
def test_the_example_of_a_sink(
    page: str, live: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import tty

    (source,) = re.findall(r'```python\n(""".*?)```', page, re.S)
    (name, value) = re.findall(r'^(\w+) = "([\w:]+)"$', page, re.M)[0]
    assert len(source.splitlines()) <= 20
    (tmp_path / f"{value.partition(':')[0]}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    entry = EntryPoint(name, value, registry.ENTRY_POINT_GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda **_: [entry])
    controller, port = os.openpty()
    tty.setraw(port)
    sink = registry.create_sink(f"{name}:{os.ttyname(port)}")
    sink.open(SinkContext("dots"))
    live.offer(sink, live.pose(3), live.lost(), live.pose(4))
    sink.close(5)
    assert os.read(controller, 1000) == b"robot 3.00 0.50 tracking\nrobot 4.00 0.50 tracking\n"
    assert (sink.status().sent, sink.status().error) == (2, "")
    os.close(controller)
    os.close(port)
    sys.modules.pop(value.partition(":")[0], None)


def test_the_table_of_json_fields(page: str, live: ModuleType) -> None:
    events: dict[str, Any] = {
        "pose": live.pose(),
        "state": live.lost(),
        "correction": live.correction(),
        "warning": live.warning(),
    }
    for kind, event in events.items():
        (row,) = re.findall(rf"^\| `{kind}` \| (.*) \|$", page, re.M)
        named = set(re.findall(r"`(\w+)`", row)) - {"tracking", "provisional", "lost"}
        assert named == set(event_to_json(event)) - {"type", "time_s"}


def test_the_table_of_the_packed_format(page: str) -> None:
    assert f"`{PACKED.format}`" in page
    assert f"{PACKED.size} bytes" in page


def test_the_table_of_addresses(page: str) -> None:
    table = page.partition("| address |")[2].partition("\n\n")[0]
    named = set(re.findall(r"`(\w+):", table))
    assert named == set(registry.SINKS) - {"web", "foxglove"}
