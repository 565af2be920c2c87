"""Signals in reports: panels of each system, and damaged, large or missing recordings."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("plotly")

from locatk.core.dots import solver as dots_solver
from locatk.core.dots.simulation import session as dots_simulate
from locatk.core.errors import FormatError
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.lighthouse import simulation as lighthouse_simulation
from locatk.core.lighthouse import solver as lighthouse_solver
from locatk.core.polaris import solver as polaris_solver
from locatk.core.polaris.array import Samples
from locatk.core.polaris.simulation import session as polaris_simulate
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.report import signals, thinning
from locatk.formats.report.panels import Panel
from locatk.formats.report.sweep_outcomes import classify_sweeps
from locatk.formats.sessions import field_samples, frames, observations
from locatk.formats.sessions.reader import Session

START_NS = 1_767_225_600_000_000_000
PNG = b"\x89PNG\r\n\x1a\n"


def traces(panel: Panel, kind: str | None = None) -> list[dict[str, Any]]:
    """Traces of a panel, as Python numbers."""
    assert panel.figure is not None
    found = json.loads(panel.figure.to_json())["data"]
    return [each for each in found if kind in (None, each["type"])]


def values(trace: Any) -> Any:
    """y of a trace of a figure, nan where nothing is."""
    return np.asarray(trace.y, float)


# ---- recordings


@pytest.fixture(scope="module")
def lighthouse(tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, Solution]:
    options = lighthouse_simulation.SimulationOptions(
        robots=2, duration_s=20.0, outliers=0.02, occlusion=0.05
    )
    made = lighthouse_simulation.simulate(options)
    path = tmp_path_factory.mktemp("signals") / "run.mcap"
    observations.write_session(path, system="lighthouse", sweeps=made.sweeps)
    session = Session.open(path)
    return session, lighthouse_solver.solve(observations.read_sweeps(session))


@pytest.fixture(scope="module")
def polaris(tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, Solution]:
    made = polaris_simulate.simulate()
    path = tmp_path_factory.mktemp("signals") / "run.mcap"
    field_samples.write_magnetometers(path, [made.samples], tags=made.tags)
    return Session.open(path), polaris_solver.solve([made.samples], made.tags)


def landmark(at_s: float, **more: Any) -> LandmarkDetection:
    """A visit as the solver tells it."""
    visit = LandmarkDetection(
        time_s=START_NS * 1e-9 + at_s,
        device="robot",
        cell=(2, 3),
        pattern="NNNS",
        code=13,
        probability=0.9,
        x_m=0.0,
        y_m=0.0,
        heading_rad=0.0,
        sigma_x_m=1e-4,
        sigma_y_m=1e-4,
        sigma_heading_rad=None,
        strength=None,
        residual_sigma=1.0,
        refused="",
    )
    return replace(visit, **more)


def hall_session(path: Path, n: int = 30_000, device: str = "robot") -> tuple[Session, np.ndarray]:
    """A quiet field with a single peak, at 200 Hz."""
    field = 1e-6 * np.sin(np.arange(n))[:, None] * np.ones(4)
    field[n // 3, 1] = 0.031
    time_ns = START_NS + np.arange(n) * 5_000_000
    field_samples.write_halls(path, [HallSamples(device, HallSensors(), time_ns, field)])
    return Session.open(path), field


def landmarks_solution(*detections: LandmarkDetection, device: str = "robot") -> Solution:
    nothing = Trajectory.from_positions(device, "map", np.array([START_NS]), np.zeros((1, 3)))
    return Solution("landmarks", "field", (nothing,), detections=detections)


# ---- systems


@pytest.mark.slow
def test_every_panel_has_words_and_draws_without_webgl(
    lighthouse: tuple[Session, Solution], polaris: tuple[Session, Solution], tmp_path: Path
) -> None:
    session, _ = hall_session(tmp_path / "halls.mcap")
    robot = landmarks_solution(landmark(20), landmark(50, refused="misread"))
    for recording, solution in (lighthouse, polaris, (session, robot)):
        for panel in signals.signal_panels(recording, solution):
            assert panel.title
            assert panel.note.endswith(".")
            assert {each["type"] for each in traces(panel)} <= {"scatter", "heatmap"}
            assert panel.figure is not None
            assert len(panel.figure.to_json()) < 1_000_000
            titles = json.dumps(json.loads(panel.figure.to_json())["layout"])
            assert "[s]" in titles


@pytest.mark.slow
def test_sweeps_are_classified_as_by_the_solver(lighthouse: tuple[Session, Solution]) -> None:
    session, solution = lighthouse
    found = signals.signal_panels(session, solution)
    assert [panel.title for panel in found] == ["Sweeps of robot-1", "Sweeps of robot-2"]
    left_out, no_pose = 0, 0
    for panel in found:
        names = [each["name"] for each in traces(panel)]
        assert {"channel 1", "channel 2", "poses"} <= set(names)
        for name in names:
            if name.startswith("rejected"):
                left_out += int(name.split("(")[1][:-1])
            if name.startswith("no pose"):
                no_pose += int(name.split("(")[1][:-1])
    by_themselves = ("plane_unknown", "spike", "repeated_in_rotation", "count_above_period")
    assert left_out == sum(solution.rejected.get(why, 0) for why in by_themselves) > 0
    assert no_pose == sum(each.rejected for each in solution.detections) > 0


def test_sweeps_of_several_photodiodes_belong_to_their_own_moments(
    lighthouse: tuple[Session, Solution], tmp_path: Path
) -> None:
    session, _ = lighthouse
    sweeps = observations.read_sweeps(session)
    one = replace(sweeps, devices=("deck",), sensor=sweeps.device, device=0 * sweeps.device)
    observations.write_session(tmp_path / "deck.mcap", system="lighthouse", sweeps=one)
    solution = lighthouse_solver.solve(one)
    assert [each.device for each in solution.trajectories] == ["deck/0", "deck/1"]
    deck = Session.open(tmp_path / "deck.mcap")
    (panel,) = signals.signal_panels(deck, solution)
    assert "no signals" not in panel.note
    held, posed = classify_sweeps(one, solution)
    assert np.count_nonzero(held & ~posed) == sum(each.rejected for each in solution.detections)


@pytest.mark.slow
def test_tags_are_marked_where_their_field_is(polaris: tuple[Session, Solution]) -> None:
    session, solution = polaris
    whole, near = signals.signal_panels(session, solution)
    assert whole.title == "Magnetic field along bar"
    (image,) = (each for each in whole.figure.data if each.type == "heatmap")
    assert image.z.shape[0] == 9
    assert_allclose(image.y, np.arange(-80, 81, 20))
    (magnets,) = (each for each in whole.figure.data if each.name == "magnets of tags")
    assert len(magnets.x) == 5
    for x, y in zip(magnets.x, magnets.y, strict=True):  # each on a dark spot
        column = np.abs(image.x - x).argmin()
        row = np.abs(image.y - y).argmin()
        around = image.z[row, max(0, column - 6) : column + 7]
        assert around.max() > 0.3 * np.nanmax(image.z)
    (read,) = (each for each in whole.figure.data if each.name == "identified (1)")
    assert str(solution.detections[0].tag_id) in read.text[0]
    assert len(near.figure.data) == 3 * 9
    assert "There was one." in near.note


def test_sensors_without_known_positions_are_numbered(
    polaris: tuple[Session, Solution], monkeypatch: pytest.MonkeyPatch
) -> None:
    session, solution = polaris
    monkeypatch.setattr(session, "attachment", lambda name: None)
    whole, _ = signals.signal_panels(session, solution)
    assert "unknown: they are numbered" in whole.note
    assert any(each.get("name") == "sensor 9" for each in traces(whole))


def test_a_dead_sensor_and_a_short_recording_are_drawn(tmp_path: Path) -> None:
    made = polaris_simulate.simulate().samples
    field = made.field_t[:30].copy()
    field[:, 4] = np.nan
    field_samples.write_magnetometers(
        tmp_path / "run.mcap", [Samples("bar", made.array, made.time_ns[:30], field)]
    )
    nothing = Solution("polaris", "joint", ())
    (panel,) = signals.signal_panels(Session.open(tmp_path / "run.mcap"), nothing)
    assert "No magnet was detected." in panel.note
    (image,) = (each for each in panel.figure.data if each.type == "heatmap")
    assert np.isnan(image.z[4]).all()
    assert np.isfinite(np.delete(image.z, 4, axis=0)).all()


def test_hall_signals_have_their_peaks_and_detections(tmp_path: Path) -> None:
    session, field = hall_session(tmp_path / "run.mcap")
    solution = landmarks_solution(
        landmark(20), landmark(50, refused="misread"), landmark(90, cell=None, pattern=None)
    )
    whole, near = signals.signal_panels(session, solution)
    (left,) = (each for each in whole.figure.data if each.name == "left")
    assert np.nanmax(values(left)) == pytest.approx(31.0)
    assert len(left.x) <= 2.1 * thinning.SIGNAL_COLUMNS
    assert "Thinned" in whole.note
    (refused,) = (each for each in whole.figure.data if each.name == "refused (1)")
    assert refused.x[0] == pytest.approx(50, abs=0.01)
    assert refused.text[0] == "misread<br>2,3<br>NNNS"
    assert "refused: misread" in refused.customdata[0]
    assert "All 3 visits are drawn." in near.note
    lines = [shape.x0 for shape in near.figure.layout.shapes]
    assert_allclose(lines, [20, 50, 90], atol=0.01)  # the time of each detection
    assert len(field) == 30_000


def test_names_of_sensors_are_escaped(tmp_path: Path) -> None:
    sensors = HallSensors(names=("<b>x</b>", "b", "c", "d"))
    time_ns = START_NS + np.arange(50) * 5_000_000
    samples = HallSamples("robot", sensors, time_ns, np.zeros((50, 4)))
    field_samples.write_halls(tmp_path / "run.mcap", [samples])
    bad = landmark(0.1, refused="<i>why</i>", pattern="<u>")
    for panel in signals.signal_panels(
        Session.open(tmp_path / "run.mcap"), landmarks_solution(bad)
    ):
        text = panel.figure.to_json()
        assert "<b>" not in text
        assert "<i>" not in text
        assert "<u>" not in text


@pytest.mark.slow
@pytest.mark.parametrize("camera", [True, False])
def test_frames_are_shown_decoded_and_rejected(tmp_path: Path, camera: bool) -> None:
    made = dots_simulate.simulate(
        dots_simulate.sheet(), dots_simulate.SimulationOptions(frames=24, missing=0.1)
    )
    images = list(made.frames.images)
    images[3] = np.full_like(images[3], 200)
    spoiled = replace(made.frames, images=images)
    lens = made.camera if camera else None
    frames.write_session(tmp_path / "run.mcap", [spoiled], made.manifest, camera=lens)
    options = dots_solver.SolveOptions(camera=lens)
    solution = dots_solver.solve([spoiled], made.manifest, options)
    shown, over_time = signals.signal_panels(Session.open(tmp_path / "run.mcap"), solution)
    assert len(shown.pictures) == 8
    assert all(each.png.startswith(PNG) for each in shown.pictures)
    captions = [each.caption for each in shown.pictures]
    assert sum("rejected, too few dots" in each for each in captions) == 1
    first = solution.detections[0]
    assert f"at {1e3 * first.x_m:.2f}, {1e3 * first.y_m:.2f} mm" in captions[0]
    by_kind = {"rejected" in each.caption: colours(each.png) for each in shown.pictures}
    assert by_kind[False] > 500  # circles and a cross
    assert by_kind[True] == 0
    names = {each["name"] for each in traces(over_time)}
    assert names == {"decoded (23)", "too few dots (1)"}


def colours(png: bytes) -> int:
    """How many pixels are not grey."""
    import cv2

    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return int(np.count_nonzero(np.ptp(picture.astype(int), axis=2) > 20))


# ---- missing, damaged and large recordings


@pytest.mark.slow
def test_a_large_recording_is_drawn_in_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    n = 200_000
    time_ns = START_NS + np.arange(n) * 5_000_000
    field = 1e-3 * rng.normal(size=(n, 4))
    field_samples.write_halls(
        tmp_path / "run.mcap", [HallSamples("robot", HallSensors(), time_ns, field)]
    )
    session = Session.open(tmp_path / "run.mcap")
    monkeypatch.setattr(signals, "MAX_READ_BYTES", 2 << 20)
    payloads, _ = signals.read_excerpt(session, session.topics("/halls/"))
    size = sum(map(len, payloads["/halls/robot"]))
    assert size < 3.5 * (1 << 20)  # of 4.8 MB unpacked
    solution = landmarks_solution(*(landmark(at) for at in np.arange(1.0, 999.0)))
    whole, near = signals.signal_panels(session, solution)
    assert "The recording is large" in whole.note
    front = next(each for each in whole.figure.data if each.name == "front")
    assert front.x[0] == pytest.approx(0, abs=1)
    assert front.x[-1] == pytest.approx(n * 0.005, rel=0.01)  # spread over the whole
    assert np.isnan(values(front)).any()  # no line over what was not read
    drawn = [each for each in near.figure.data if each.name == "front"]
    assert drawn
    assert all(len(each.x) > 10 for each in drawn)  # only where samples were read


def test_damaged_parts_are_left_out_and_counted(tmp_path: Path) -> None:
    session, _ = hall_session(tmp_path / "run.mcap", n=100_000)
    segment = session.index.segments[1]
    data = bytearray((tmp_path / "run.mcap").read_bytes())
    middle = segment.offset + segment.length // 2
    data[middle : middle + 8] = b"\xff" * 8
    (tmp_path / "run.mcap").write_bytes(data)
    whole, *_ = signals.signal_panels(Session.open(tmp_path / "run.mcap"), landmarks_solution())
    assert f"1 of {len(session.index.segments)} parts of the recording are damaged" in whole.note
    assert "No landmark was detected." in whole.note


def test_a_recording_cut_short_shows_what_is_left(
    tmp_path: Path, polaris: tuple[Session, Solution]
) -> None:
    session, solution = polaris
    data = Path(session.path).read_bytes()
    for share in (0.2, 0.5, 0.9):
        (tmp_path / "cut.mcap").write_bytes(data[: int(share * len(data))])
        cut = Session.open(tmp_path / "cut.mcap", damaged_ok=True)
        found = signals.signal_panels(cut, solution)
        assert found
        assert all(panel.note for panel in found)


def test_recordings_of_other_systems_have_a_note(
    tmp_path: Path, polaris: tuple[Session, Solution], lighthouse: tuple[Session, Solution]
) -> None:
    (panel,) = signals.signal_panels(polaris[0], lighthouse[1])
    assert panel.note == "No signals of lighthouse in the recording: it is of polaris."
    (panel,) = signals.signal_panels(lighthouse[0], replace(lighthouse[1], system="sonar"))
    assert "'sonar' cannot be drawn" in panel.note
    for system in signals.MODULES:
        other = polaris[0] if system != "polaris" else lighthouse[0]
        (panel,) = signals.signal_panels(other, Solution(system, "x", ()))
        assert panel.figure is None
        assert panel.note
    session, _ = hall_session(tmp_path / "run.mcap", n=500)
    whole, *_ = signals.signal_panels(session, landmarks_solution(device="another"))
    assert "The recording has no signals of another, although there are poses." in whole.note


def test_devices_that_are_not_drawn_are_listed(tmp_path: Path) -> None:
    time_ns = START_NS + np.arange(50) * 5_000_000
    samples = [
        HallSamples(f"robot-{k}", HallSensors(), time_ns, np.zeros((50, 4))) for k in range(6)
    ]
    field_samples.write_halls(tmp_path / "run.mcap", samples)
    found = signals.signal_panels(
        Session.open(tmp_path / "run.mcap"), Solution("landmarks", "field", ())
    )
    assert len(found) == signals.MAX_DEVICES
    assert "Not drawn: robot-4, robot-5." in found[0].note


def test_a_missing_recording_has_a_note(tmp_path: Path, polaris: tuple[Session, Solution]) -> None:
    session, solution = polaris
    data = Path(session.path).read_bytes()
    (tmp_path / "gone.mcap").write_bytes(data)
    gone = Session.open(tmp_path / "gone.mcap")
    (tmp_path / "gone.mcap").unlink()
    (panel,) = signals.signal_panels(gone, solution)
    assert "cannot be drawn: no such file" in panel.note
    assert panel.title == signals.SIGNALS_TITLE


def test_the_hint_on_a_damaged_recording_is_shown(
    polaris: tuple[Session, Solution], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(session: Session, solution: Solution) -> list[Panel]:
        raise FormatError("too damaged", hint="Recover it")

    session, solution = polaris
    monkeypatch.setattr(import_module(signals.MODULES["polaris"]), "signal_panels", fail)
    (panel,) = signals.signal_panels(session, solution)
    assert panel.note == "The recording cannot be drawn: too damaged. Recover it."
