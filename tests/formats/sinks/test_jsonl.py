"""JSON lines."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from locatk.core.errors import InputError, LocatkError, OutputExistsError
from locatk.formats.sinks import queued
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.registry import create_sink


def lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def opened(path: Path, options: str = "") -> Any:
    sink = create_sink(f"jsonl:{path}{options}")
    sink.open(SinkContext("dots"))
    return sink


def test_events_are_in_the_file_at_once(live: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    sink = opened(path)
    live.offer(sink, live.pose(0, "Küche"))
    live.wait_for(lambda: sink.status().sent == 1)
    (first,) = lines(path)
    assert (first["device"], first["x_m"], first["type"]) == ("Küche", 0, "pose")
    assert "latency_s" in first
    events = [live.pose(k) if k % 2 else live.correction(k) for k in range(1, 500)]
    live.offer(sink, *events, live.position_only())
    sink.close(5)
    table = lines(path)
    assert len(table) == 501
    assert [row.get("x_m", row.get("displacement_m", [0])[0]) for row in table[:500]] == list(
        range(500)
    )
    assert table[-1]["qw"] is None
    assert sink.status().sent == 501
    assert sink.status().address == str(path)


def test_numbers_that_are_not_finite_are_null(live: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    sink = opened(path)
    live.offer(sink, live.pose(probability=math.nan), live.position_only())
    sink.close(5)
    assert "NaN" not in path.read_text()
    assert [row["probability"] for row in lines(path)] == [None, None]


def test_existing_file_is_kept_unless_told_otherwise(live: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    path.write_text("precious\n")
    with pytest.raises(LocatkError, match="output exists") as caught:
        opened(path)
    assert "?overwrite" in str(caught.value.hint)
    assert path.read_text() == "precious\n"
    sink = opened(path, "?overwrite")
    live.offer(sink, live.pose(3))
    sink.close(5)
    assert [row["x_m"] for row in lines(path)] == [3]


def test_disk_that_is_full_for_a_while(
    live: ModuleType, small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queued, "FIRST_RETRY_S", 0.01)
    filler, path = small_disk / "filler", small_disk / "poses.jsonl"
    with filler.open("wb") as stream:
        stream.write(bytes(9 * 2**20 - 3 * 4096))
    sink = opened(path)
    long_reason = "x" * 3000
    live.offer(sink, *(live.lost(f"robot{k}", long_reason) for k in range(10)))
    live.wait_for(lambda: "space" in sink.status().error)
    complete = lines(path)  # each line is whole
    assert 0 < len(complete) < 10
    filler.unlink()
    live.wait_for(lambda: sink.status().sent == 10)
    live.wait_for(lambda: sink.status().error == "")
    sink.close(5)
    assert [row["device"] for row in lines(path)] == [f"robot{k}" for k in range(10)]
    assert sink.status().dropped == 0


@pytest.mark.parametrize("text", ["jsonl:", "jsonl:-"])
def test_no_file(text: str) -> None:
    with pytest.raises(InputError, match="no file"):
        create_sink(text)


def test_unusable_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown option"):
        create_sink("jsonl:a.jsonl?append")
    with pytest.raises(LocatkError, match="no such folder"):
        opened(tmp_path / "missing" / "a.jsonl")
    with pytest.raises(OutputExistsError, match="not a regular file"):
        opened(tmp_path, "?overwrite")
