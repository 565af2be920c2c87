"""Reports: one file, harmless whatever devices are called, small, and the same every time."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.errors import MissingDataError, OutputExistsError
from locatk.core.evaluation import evaluate
from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.solution import GenericRecord, Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.ground import build_ground, with_finite_positions
from locatk.formats.report.evaluation import covariance_panels, error_panels
from locatk.formats.report.report import render_report, report_panels, write_report
from locatk.formats.report.subject import Subject
from locatk.formats.report.thinning import MAX_POSES
from locatk.formats.report.trajectory_map import map_panels
from locatk.formats.sessions.reader import Session

START_NS = 1_767_225_600_000_000_000
EVIL = "</script><img src=x onerror=alert(1)>"
SCENE = Scene(
    stations=(Station(1, np.array([-2.0, 0.0, 2.0]), np.eye(3), IDEAL_CALIBRATION),),
    markers=(Marker("corner", np.array([0.5, 0.5, 0.0])),),
    planar=True,
    scale="markers",
)


def track(
    device: str, n: int = 60, off_m: float = 0.0, frame: str = "floor", rise_m: float = 0.0
) -> Trajectory:
    """A loop of ``n`` poses, a tenth of a second apart, known to 1 mm."""
    turn = np.linspace(0, 6, n)
    position = np.column_stack([np.cos(turn) + off_m, np.sin(turn), rise_m * turn])
    time_ns = START_NS + 100_000_000 * np.arange(n)
    covariance = np.broadcast_to(np.eye(3) * 1e-6, (n, 3, 3))
    return Trajectory.from_positions(device, frame, time_ns, position, covariance)


def solution(*names: str, n: int = 60, **more: Any) -> Solution:
    tracks = tuple(track(name, n, off_m=1e-3 * (k + 1)) for k, name in enumerate(names))
    given: dict[str, Any] = {
        "artifact": SCENE,
        "warnings": (SolverWarning("test", "a note"),),
        **more,
    }
    return Solution("lighthouse", "bundle", tracks, **given)


def evaluated(solved: Solution, **more: Any) -> Subject:
    """A subject with truth."""
    truth = tuple(track(t.device, len(t)) for t in solved.trajectories)
    pairs = [(t, u) for t, u in zip(solved.trajectories, truth, strict=True) if len(t)]
    evaluation = evaluate(pairs) if pairs else None
    return Subject("run.mcap", solved, truth=truth, evaluation=evaluation, **more)


def specs(page: str) -> dict[str, Any]:
    """The figures of a page by id."""
    found = re.findall(
        r'<script type="application/json" id="([^"]+)-data">(.*?)</script>', page, re.S
    )
    return {ident: json.loads(data) for ident, data in found}


def values(array: Any) -> np.ndarray:
    """An array as plotly writes it."""
    if isinstance(array, dict):
        flat = np.frombuffer(base64.b64decode(array["bdata"]), np.dtype(array["dtype"]))
        return flat.reshape([int(n) for n in str(array.get("shape", len(flat))).split(",")])
    return np.array([np.nan if v is None else v for v in array], float)


# ---- the file


@pytest.fixture(autouse=True)
def _short_script(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave plotly.js, which is 5 MB, out of the pages."""
    monkeypatch.setattr("locatk.formats.report.page.get_plotlyjs", lambda: "// plotly.js")


@pytest.mark.slow
def test_one_copy_of_the_script_and_no_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    path = tmp_path / "report.html"
    write_report(path, [evaluated(solution("red")), evaluated(solution("blue"))])
    page = path.read_text(encoding="utf-8")
    assert page.count("plotly.js v") == 1
    scripts = re.findall(r"<script>(.*?)</script>", page, re.S)
    assert len(scripts) == 2
    rest = page.replace(scripts[0], "")
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:|//)""", rest)
    assert "http://" not in rest
    assert "https://" not in rest
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy.startswith("default-src 'none'; ")
    allowed = re.findall(r"'sha256-([^']+)'", policy)
    of = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    assert allowed == of
    assert "unsafe-eval" not in policy
    assert "'unsafe-inline'" not in policy.split("style-src")[0]


@pytest.mark.slow
def test_the_same_subjects_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        write_report(tmp_path / name, [evaluated(solution("red"))])
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_an_existing_file_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.html"
    path.write_text("mine")
    with pytest.raises(OutputExistsError):
        write_report(path, [evaluated(solution("red"))])
    assert path.read_text() == "mine"
    write_report(path, [evaluated(solution("red"))], overwrite=True)
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    with pytest.raises(MissingDataError):
        write_report(tmp_path / "nowhere" / "a.html", [evaluated(solution("red"))])


@pytest.mark.slow
def test_neither_matplotlib_nor_scipy_is_imported() -> None:
    """They would take longer than all else."""
    code = (
        "import sys, locatk.formats.report.report, locatk.formats.report.subject; "
        "print([m for m in ('matplotlib', 'scipy', 'magpylib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# ---- foreign text


@pytest.mark.slow
def test_names_of_devices_do_no_harm() -> None:
    facts = {"command": f"locatk solve {EVIL}", "source": EVIL, "other": EVIL}
    warnings = (SolverWarning("test", EVIL),)
    subject = replace(evaluated(solution(EVIL, warnings=warnings), facts=facts), name=EVIL)
    page = render_report([subject, subject])
    assert "<img" not in page
    assert page.lower().count("</script>") == page.count("<script")
    # In figures it is escaped once more: plotly takes text for HTML.
    names = {t.get("name") for spec in specs(page).values() for t in spec["data"]}
    assert not any(name and "<" in name for name in names)
    assert any(name and "&lt;" in name for name in names)


@pytest.mark.slow
def test_odd_names_are_shown() -> None:
    names = ("Łódź 🤖", "%{x}", "$5^2$", "_x", "a\nb", "<b>bold</b>", " ")
    assert specs(render_report([evaluated(solution(*names))]))


def test_the_command_is_there_to_be_copied() -> None:
    page = render_report(
        [evaluated(solution("red"), facts={"command": "locatk solve 'a b.mcap' -o <x>"})]
    )
    assert "locatk solve &#x27;a b.mcap&#x27; -o &lt;x&gt;</pre>" in page
    assert 'class="copy"' in page


# ---- text


def texts(subject: Subject) -> str:
    return re.sub(
        r"<script.*?</script>|<style.*?</style>", "", render_report([subject]), flags=re.S
    )


def test_the_summary_is_that_of_the_evaluation() -> None:
    said = texts(evaluated(solution("red")))
    assert "Half of the poses are within 1.00 mm of the truth, 95 % within 1.00 mm" in said
    assert "No alignment was fitted" in said
    assert "a note" in said


def test_without_truth_the_report_shows_sigmas() -> None:
    subject = Subject("run.mcap", solution("red"), facts={"source": "run.mcap"})
    said = texts(subject)
    assert "No truth is available" in said
    assert "1.73 mm" in said  # of three axes of 1 mm
    assert "The session run.mcap is not in the folder of the solution: its signals" in said
    titles = [panel.title for panel in report_panels(subject)]
    assert "Standard deviation over time" in titles
    assert not any("Error" in title for title in titles)


def test_truth_of_another_time_is_no_error() -> None:
    late = replace(track("red"), time_ns=track("red").time_ns + 10**12)
    said = texts(Subject("run.mcap", solution("red"), truth=(late,)))
    assert "No pose has truth of its device at its time" in said


@pytest.mark.slow
def test_a_scene_without_scale_has_no_metres() -> None:
    solved = solution("red", artifact=replace(SCENE, scale="unit"))
    subject = Subject("run.mcap", solved, truth=(track("red"),))
    said = texts(subject)
    assert "The scene has no scale" in said
    assert "--align sim3" in said
    assert not re.search(r"\d mm\b", said)
    page = render_report([subject])
    layouts = [spec["layout"] for spec in specs(page).values()]
    titles = [layout.get("xaxis", {}).get("title", {}).get("text") for layout in layouts]
    assert "x [unit]" in titles


@pytest.mark.parametrize(
    "empty",
    [
        Solution("lighthouse", "bundle", ()),
        Solution("lighthouse", "bundle", (), artifact=SCENE),
        solution("red", n=0),
        Solution("dots", "lattice", (track("red", 0),), rejected={"blurred": 7}),
    ],
)
def test_a_solution_without_poses_has_a_report(empty: Solution) -> None:
    said = texts(Subject("run.mcap", empty))
    assert "Nothing was solved" in said


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_poses_have_a_report(n: int) -> None:
    assert report_panels(evaluated(solution("red", n=n)))


def test_poses_without_covariance_have_a_report() -> None:
    t = track("red")
    bare = Trajectory.from_positions(t.device, t.frame, t.time_ns, t.position)
    subject = evaluated(replace(solution("red"), trajectories=(bare,)))
    assert "Standard deviation over time" not in [panel.title for panel in report_panels(subject)]
    assert "reports no covariance" in texts(replace(subject, evaluation=None, truth=()))


@pytest.mark.slow
def test_poses_that_are_not_finite_are_left_out_and_counted() -> None:
    solved = solution("red")
    solved.trajectories[0].position[5:9] = np.nan
    truth = (track("red"),)
    pairs = [(with_finite_positions(t), u) for t, u in zip(solved.trajectories, truth, strict=True)]
    subject = Subject("a", solved, truth=truth, evaluation=evaluate(pairs))
    said = texts(subject)
    assert "Half of the poses are within 1.00 mm" in said
    assert "4 poses are not finite and neither drawn nor evaluated." in said
    solved.trajectories[0].position[:] = np.nan
    said = texts(Subject("a", solved, truth=truth))
    assert "No pose is finite: there are no errors." in said
    assert "60 poses are not finite" in said


@pytest.mark.slow
def test_devices_without_truth_are_named() -> None:
    subject = evaluated(solution("red", "blue"))
    only = evaluate([(subject.solution.trajectories[0], subject.truth[0])])
    said = figure(replace(subject, evaluation=only), "Statistics").note
    assert "There is no truth for blue." in said
    assert "All poses are scored" not in said
    assert "All poses are scored." in figure(subject, "Statistics").note


@pytest.mark.slow
def test_facts_have_units_and_no_lists_for_programs() -> None:
    facts = {"speed_mps": 0.5, "frames": [{"x": k} for k in range(200)], "robots": {"a": {"n": 1}}}
    subject = Subject(
        "a", solution("red", facts=GenericRecord(facts)), facts={"options_sha256": "00"}
    )
    assert dict(figure(subject, "Facts of the solver").table.rows) == {
        "speed [m/s]": "0.5",
        "robots: a: n": "1",
    }
    assert "options" not in texts(subject)
    only = Subject("a", solution("red", facts=GenericRecord({"frames": [{}] * 200})))
    assert "Facts of the solver" not in [panel.title for panel in report_panels(only)]


# ---- figures


def times(panel: Any) -> list[float]:
    """All times that a figure of numbers over time shows."""
    found = [np.asarray(t.x, float) for t in panel.figure.data]
    return np.concatenate([x[np.isfinite(x)] for x in found]).tolist()


@pytest.mark.slow
def test_all_time_axes_begin_with_the_recording() -> None:
    recording = SimpleNamespace(
        start_ns=START_NS - 3_000_000_000, end_ns=START_NS + 10**10, facts={}
    )
    subject = evaluated(solution("red"))
    titles = ("Error over time", "Error by axis", "Standard deviation over time")
    for title in titles:
        assert min(times(figure(subject, title))) == pytest.approx(0.0)
    from_session = replace(subject, session=cast("Session", recording))
    shown = {p.title: p for p in (*error_panels(from_session), *covariance_panels(from_session))}
    for title in titles:
        assert min(times(shown[title])) == pytest.approx(3.0)
    assert "time 0 is the first pose, 2026-01-01 00:00:00 UTC" in texts(subject)
    late = replace(from_session, session=cast("Session", replace_start(recording)))
    assert "from another time than the poses" in texts(late)


def replace_start(recording: Any) -> Any:
    """The same an hour later."""
    hour = 3600 * 10**9
    return SimpleNamespace(
        start_ns=recording.start_ns + hour, end_ns=recording.end_ns + hour, facts={}
    )


def test_devices_come_first_in_legends() -> None:
    traces = figure(evaluated(solution("red")), "Trajectory").figure.data
    ranks = {t.name: t.legendrank or 1000 for t in traces if t.showlegend is not False}
    assert min(ranks, key=lambda name: ranks[name]) == "red"


def test_a_thinned_path_breaks_only_at_gaps() -> None:
    t = track("red", 6000)
    t.time_ns[3000:] += 30_000_000_000
    panel = figure(Subject("a", replace(solution("red"), trajectories=(t,))), "Trajectory")
    line = next(each for each in panel.figure.data if each.name == "red")
    assert "Drawn are" in panel.note
    assert np.count_nonzero(np.isnan(np.asarray(line.x, float))) == 1


def figure(subject: Subject, title: str) -> Any:
    (panel,) = [panel for panel in report_panels(subject) if panel.title == title]
    return panel


def test_the_map_is_to_scale_and_shows_what_is_there() -> None:
    panel = figure(evaluated(solution("red")), "Trajectory")
    assert panel.figure.layout.yaxis.scaleanchor == "x"
    traces = {t.name: t for t in panel.figure.data}
    assert {"truth", "red", "marker", "station"} <= set(traces)
    np.testing.assert_allclose(traces["marker"].x, [0.5])
    np.testing.assert_allclose(traces["station"].x, [-2.0])
    low, high = panel.figure.layout.xaxis.range
    assert low < -2
    assert high > 1
    # 1 mm cannot be seen on 3 m: ellipses are larger by a round number, which is said.
    assert "drawn 10 times as large" in panel.note
    assert traces["95 % ellipse, \u00d7 10"]


def test_ellipses_have_the_right_size() -> None:
    t = track("red")
    covariance = np.zeros((len(t), 3, 3))
    covariance[:, 0, 0], covariance[:, 1, 1] = 0.04, 0.01
    wide = Trajectory.from_positions(t.device, t.frame, t.time_ns, t.position, covariance)
    panel = figure(Subject("a", replace(solution("red"), trajectories=(wide,))), "Trajectory")
    (trace,) = [t for t in panel.figure.data if t.name == "95 % ellipse"]
    first = np.array([trace.x[:25], trace.y[:25]], float)
    np.testing.assert_allclose(np.ptp(first, axis=1), 2 * 2.4477 * np.array([0.2, 0.1]), rtol=1e-3)


def test_ellipses_are_in_the_frame_of_the_truth() -> None:
    t = track("red")
    covariance = np.broadcast_to(np.diag([0.04, 0.01, 0.0]), (len(t), 3, 3))
    wide = Trajectory.from_positions(t.device, t.frame, t.time_ns, t.position, covariance)
    solved = replace(solution("red"), trajectories=(wide,))
    to_truth = Similarity(0.5, rotation_exp([0.0, 0.0, np.pi / 2]), np.zeros(3))
    ground = replace(build_ground(solved), transform=to_truth)
    panel = map_panels(solved, ground, START_NS, "Trajectory")[0]
    assert panel.figure is not None
    (trace,) = [t for t in panel.figure.data if str(t.name).startswith("95 % ellipse")]
    first = np.array([trace.x[:25], trace.y[:25]], float)
    np.testing.assert_allclose(np.ptp(first, axis=1), 2 * 2.4477 * np.array([0.05, 0.1]), rtol=1e-3)


@pytest.mark.slow
def test_a_path_that_rises_is_seen_from_the_side() -> None:
    steep = replace(solution("red"), trajectories=(track("red", rise_m=0.1),))
    titles = [panel.title for panel in report_panels(evaluated(steep))]
    assert "Trajectory from the side" in titles
    assert "Trajectory from the side" not in [
        p.title for p in report_panels(evaluated(solution("red")))
    ]


def test_poses_in_two_frames_share_no_map() -> None:
    sheets = tuple(
        Sheet(name, (1000 * k, 0), (100, 100), (0, 0), (60.0, 60.0), (5.0, 5.0))
        for k, name in enumerate(("a", "b"))
    )
    tracks = tuple(track(f"camera-{name}", frame=name) for name in "ab")
    solved = Solution("dots", "lattice", tracks, artifact=Manifest(sheets))
    found = [p for p in report_panels(Subject("x", solved)) if p.title.startswith("Trajectory")]
    assert [p.title for p in found] == ["Trajectory in a", "Trajectory in b"]
    for panel, name in zip(found, "ab", strict=True):
        assert panel.figure is not None
        names = [t.name for t in panel.figure.data]
        assert names.count("paper") == 1
        assert f"camera-{name}" in names


@pytest.mark.slow
def test_outliers_are_at_the_upper_limit_and_counted() -> None:
    solved = solution("red", n=100)
    solved.trajectories[0].position[50, 0] += 40.0
    panel = figure(evaluated(solved), "Error over time")
    assert "1 of 100 values lie beyond this scale (triangles)" in panel.note
    (triangle,) = [t for t in panel.figure.data if t.yaxis == "y2"]
    np.testing.assert_allclose(triangle.customdata, [40_001.0], rtol=1e-6)
    assert panel.figure.layout.yaxis.range[1] < 10
    histogram = figure(evaluated(solved), "Histogram of errors").figure
    assert sum(histogram.data[0].y) == 100
    note = figure(evaluated(solved), "Histogram of errors").note
    assert note == "1 of 100 poses beyond this scale are in the last bin."
    # The median and the 95 % quantile, both 1 mm.
    np.testing.assert_allclose([line.x0 for line in histogram.layout.shapes], [1.0, 1.0], rtol=0.1)


def test_errors_and_bands_are_those_of_the_solution() -> None:
    subject = evaluated(solution("red"))
    panel = figure(subject, "Error over time")
    shown = {t.name: t for t in panel.figure.data}
    np.testing.assert_allclose(shown["red"].y, 1.0, atol=1e-9)
    # Of the length of three normal errors of 1 mm 95 % are below 2.795 mm (chi-squared).
    np.testing.assert_allclose(shown["95 % expected"].y, 2.7955, rtol=4e-3)


# ---- large solutions


@pytest.mark.slow
def test_ten_thousand_poses_are_thinned_and_small() -> None:
    names = [f"robot-{k}" for k in range(12)]
    rng = np.random.default_rng(1)
    solved = solution(*names, n=900)
    for t in solved.trajectories:
        t.position[:] += 1e-3 * rng.standard_normal(t.position.shape)
    solved.trajectories[3].position[417] += 5.0  # must not be lost
    page = render_report([evaluated(solved)])
    assert len(page.encode()) < 12e6
    assert "of 10\u202f800 poses" in page
    for ident, spec in specs(page).items():
        points = sum(len(values(t["x"])) for t in spec["data"] if "markers" in t.get("mode", ""))
        assert points < 1.3 * MAX_POSES, ident
    paths = [t for t in specs(page)["s1-1-figure"]["data"] if t.get("name") == "robot-3"]
    assert max(np.nanmax(values(t["x"])) for t in paths) > 4


@pytest.mark.slow
def test_few_devices_are_named_and_the_rest_counted() -> None:
    for devices, expected in ((20, 20), (30, 20)):
        solved = solution(*[f"robot-{k}" for k in range(devices)], n=5)
        panel = figure(evaluated(solved), "Trajectory")
        named = [t for t in panel.figure.data if t.showlegend and str(t.name).startswith("robot")]
        assert len(named) == expected
        assert len({t.line.color for t in named}) == expected
        assert ("The legend names 20 of 30 devices" in panel.note) == (devices == 30)


@pytest.mark.slow
def test_several_subjects_are_in_a_table_with_links() -> None:
    page = render_report([evaluated(solution("red")), Subject("b.mcap", solution("blue"))])
    assert '<a href="#s2">b.mcap</a>' in page
    assert page.count('class="subject"') == 2
    overview = page[page.index('<nav class="sortable">') : page.index("</nav>")]
    for name in ("devices", "duration", "coverage", "APE median", "p95", "max", "NEES", "warnings"):
        assert f">{name}</th>" in overview
    assert len(specs(page)) == len(set(specs(page)))
