"""Records `station-<channel>`: exact round trips, errors that name the record."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.recording import StationReport, Sweeps
from locatk.core.lighthouse.scene import Scene, Station
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.station_reports import describe_unknown_stations, read_station_reports
from locatk.formats.sessions.writer import SessionWriter

NONE = np.zeros(0, np.int32)
NO_SWEEPS = Sweeps((), NONE.astype(np.int64), NONE, NONE, NONE, NONE, NONE, NONE.astype(float))

counts = st.integers(0, 10**15)


@st.composite
def stations(draw: st.DrawFn, channel: int) -> StationReport:
    values = st.lists(st.floats(-10, 10), min_size=14, max_size=14)
    calibration = values.map(lambda v: Calibration(np.array(v).reshape(2, 7), "factory"))
    return StationReport(
        channel=channel,
        id=draw(st.none() | st.integers(0, 2**32 - 1)),
        period_ticks=draw(st.none() | st.floats(8e5, 1e6)),
        sweeps=draw(counts),
        missed=draw(st.none() | counts),
        calibration=draw(st.none() | calibration),
        frames=draw(counts),
        damaged=draw(counts),
        acceleration=draw(st.none() | st.tuples(*[st.integers(-128, 127)] * 3)),
    )


heard = st.lists(st.integers(1, 16), max_size=4, unique=True).flatmap(
    lambda channels: st.tuples(*(stations(channel) for channel in sorted(channels)))
)


def plain(station: StationReport) -> dict[str, object]:
    calibration = station.calibration
    told = None if calibration is None else (calibration.sweeps.tolist(), calibration.source)
    return {**vars(station), "calibration": told}


def write(
    path: Path, found: tuple[StationReport, ...], scene: Scene | None = None, **more: bool
) -> Session:
    observations.write_session(
        path, system="lighthouse", sweeps=NO_SWEEPS, scene=scene, stations=found, **more
    )
    return Session.open(path)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(heard)
def test_station_reports_are_restored(
    tmp_path_factory: pytest.TempPathFactory, found: tuple[StationReport, ...]
) -> None:
    path = tmp_path_factory.mktemp("heard") / "run.mcap"
    read = read_station_reports(write(path, found))
    assert [plain(station) for station in read] == [plain(station) for station in found]
    scene = observations.read_scene(Session.open(path))
    in_scene = [(s.id, s.calibration, s.acceleration) for s in found]
    assert (scene is None) == all(values == (None, None, None) for values in in_scene)
    if scene is not None:
        assert scene.ids == {s.channel: s.id for s in found if s.id is not None}
        assert sorted(scene.calibrations) == [s.channel for s in found if s.calibration]


FACTORY = Calibration(np.full((2, 7), 0.01), "factory")
MINE = Calibration(np.zeros((2, 7)), "estimated")


def test_the_calibration_of_the_scene_stays(tmp_path: Path) -> None:
    """What an importer puts into the scene is not replaced by what the stations sent."""
    sent = (StationReport(1, 7, calibration=FACTORY), StationReport(2, 8, calibration=FACTORY))
    session = write(tmp_path / "run.mcap", sent, Scene(calibrations={1: MINE}, ids={1: 9}))
    scene = observations.read_scene(session)
    assert scene is not None
    assert [scene.calibrations[c].source for c in (1, 2)] == ["estimated", "factory"]
    assert scene.ids == {1: 9, 2: 8}
    assert [s.id for s in read_station_reports(session)] == [7, 8]
    assert session.metadata()["station-1"]["calibration"] == "factory"


@pytest.mark.parametrize(
    "found",
    [
        (StationReport(3), StationReport(3)),
        (StationReport(0),),
        (StationReport(17),),
        (StationReport(3, sweeps=-1),),
        (StationReport(3, period_ticks=float("nan")),),
        (StationReport(3, period_ticks=0.0),),
        (StationReport(3, id=-4),),
    ],
    ids=str,
)
def test_impossible_reports_are_not_written(
    tmp_path: Path, found: tuple[StationReport, ...]
) -> None:
    with pytest.raises(InputError):
        write(tmp_path / "run.mcap", found)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "key", "text", "words"),
    [
        ("station-17", "sweeps", "1", "channel '17'"),
        ("station-0", "sweeps", "1", "channel '0'"),
        ("station-", "sweeps", "1", "channel ''"),
        ("station-1\n", "sweeps", "1", "channel"),
        ("station-²", "sweeps", "1", "channel"),
        ("station-3", "id", "xyz", "id 'xyz'"),
        ("station-3", "id", "0x12", "id"),
        ("station-3", "id", "1" * 17, "id"),
        ("station-3", "period_ticks", "-1.0", "period_ticks"),
        ("station-3", "period_ticks", "inf", "period_ticks"),
        ("station-3", "period_ticks", "nan", "period_ticks"),
        ("station-3", "period_ticks", "fast", "period_ticks 'fast'"),
        ("station-3", "sweeps", "1.5", "sweeps '1.5'"),
        ("station-3", "missed", "-1", "missed"),
        ("station-3", "frames", "9" * 5000, "frames"),
        ("station-3", "damaged", "٣", "damaged"),
        ("station-3", "acceleration", "1 2", "acceleration '1 2' is not three signed bytes"),
        ("station-3", "acceleration", "1 2 999", "not three signed bytes"),
    ],
)
def test_a_damaged_record_is_named(
    tmp_path: Path, name: str, key: str, text: str, words: str
) -> None:
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        writer.metadata(name, {key: text})
    with pytest.raises(FormatError, match=words) as caught:
        read_station_reports(Session.open(path))
    assert caught.value.where == (name if name.isprintable() else ascii(name))
    assert len(str(caught.value)) < 300


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["station-1", "station-16", "station-x"]) | st.text(max_size=4),
        st.dictionaries(
            st.sampled_from(["id", "period_ticks", "sweeps", "missed", "calibration", "frames"]),
            st.text(max_size=12) | st.integers().map(str) | st.floats().map(repr),
        ),
    )
)
def test_wild_records(
    tmp_path_factory: pytest.TempPathFactory, records: dict[str, dict[str, str]]
) -> None:
    path = tmp_path_factory.mktemp("wild") / "run.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        for name, record in records.items():
            writer.metadata(name, record)
    try:
        found = read_station_reports(Session.open(path))
    except LocatkError:
        return
    assert all(1 <= station.channel <= 16 for station in found)


def test_a_station_that_differs_from_the_scene_is_reported() -> None:
    place = Station(1, np.zeros(3), np.eye(3), FACTORY, id=0xA)
    scene = Scene(stations=(place,), ids={2: 0xB})
    found = (StationReport(1, 0xA), StationReport(2, 0xC), StationReport(3, 0xD), StationReport(4))
    [note] = describe_unknown_stations(scene, found)
    assert note.startswith("channel 2: the scene contains station 0000000b")
