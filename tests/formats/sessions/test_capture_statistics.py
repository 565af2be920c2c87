"""Counts of a recording: differences, descriptions of losses, and the metadata record."""

from __future__ import annotations

from dataclasses import fields

from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.formats.sessions.capture_statistics import CaptureStatistics

counts = st.integers(0, 10**12)
samples = st.dictionaries(st.sampled_from(("/a", "/b", "/c")), counts)


@st.composite
def totals(draw: st.DrawFn) -> CaptureStatistics:
    values = {
        each.name: draw(samples if each.name == "samples" else counts)
        for each in fields(CaptureStatistics)
    }
    return CaptureStatistics(**values)


@settings(max_examples=30, deadline=None)
@given(before=totals(), more=totals())
def test_what_was_counted_since(before: CaptureStatistics, more: CaptureStatistics) -> None:
    now = CaptureStatistics(
        **{
            each.name: getattr(before, each.name) + getattr(more, each.name)
            for each in fields(CaptureStatistics)
            if each.name != "samples"
        },
        samples={
            topic: before.samples.get(topic, 0) + more.samples.get(topic, 0)
            for topic in {*before.samples, *more.samples}
        },
    )
    since = now.since(before)
    for each in fields(CaptureStatistics):
        if each.name in ("high_water_bytes", "clock_step_s"):
            assert getattr(since, each.name) == getattr(now, each.name)
        elif each.name != "samples":
            assert getattr(since, each.name) == getattr(more, each.name)
    assert {topic: n for topic, n in since.samples.items() if n} == {
        topic: n for topic, n in more.samples.items() if n
    }


def test_nothing_lost_says_nothing() -> None:
    assert CaptureStatistics(bytes=5, frames=2, skipped=3, unknown=1, silences=1).losses() == []


def test_each_loss_is_said() -> None:
    lost = CaptureStatistics(gaps=2, gap_s=3.04, overruns=7, line_errors=5, bad=1, lost=4).losses()
    assert len(lost) == 5
    assert lost[0] == "connection lost 2 times, 3.0 s in all"
    for words in ("7 bytes overrun", "5 bytes with line errors", "1 bad frame", "4 frames missing"):
        assert any(words in phrase for phrase in lost)
    assert CaptureStatistics(gaps=1, gap_s=1.0).losses() == ["connection lost once, 1.0 s in all"]


def test_doubts_whether_it_is_this_device() -> None:
    assert CaptureStatistics().doubts("lines") == ["no data were received"]
    assert CaptureStatistics(bytes=9).doubts("raw") == []
    assert CaptureStatistics(bytes=9).doubts("lines") == ["no frame of lines in 9 bytes"]
    assert CaptureStatistics(bytes=9, frames=1, skipped=4).doubts("lines") == []
    assert CaptureStatistics(bytes=9, frames=1, skipped=5).doubts("lines") == [
        "5 of 9 bytes are in no valid frame of lines"
    ]


def test_every_figure_goes_into_the_metadata_as_text() -> None:
    texts = CaptureStatistics(bytes=5, gap_s=1.5, samples={"/halls/red": 7}).texts()
    names = {each.name for each in fields(CaptureStatistics)} - {"samples"}
    assert set(texts) == names | {"samples:/halls/red"}
    assert texts["bytes"] == "5"
    assert float(texts["gap_s"]) == 1.5
    assert texts["samples:/halls/red"] == "7"
    assert all(isinstance(text, str) for text in texts.values())
