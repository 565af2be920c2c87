"""Pictures: of every kind, never over another, with every word inside the frame."""

from __future__ import annotations

import importlib.util
import pkgutil
import struct
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from locatk.core.errors import InputError, MissingDataError, OutputExistsError
from locatk.core.evaluation import EvaluationOptions, evaluate
from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats import plots
from locatk.formats.plots.figure_files import SUFFIXES
from locatk.formats.plots.picture import draw_picture, write_picture

START_NS = 1_767_225_600_000_000_000
ROTATION = rotation_exp([0.0, 0.6, 0.0])


def track(device: str, n: int = 120, off_m: float = 0.0, sigma_m: float = 1e-3) -> Trajectory:
    """A loop of ``n`` poses, a tenth of a second apart."""
    turn = np.linspace(0, 6, n)
    position = np.column_stack([np.cos(turn) + off_m, np.sin(turn), 0 * turn])
    time_ns = START_NS + 100_000_000 * np.arange(n)
    covariance = np.broadcast_to(np.eye(3) * sigma_m**2, (n, 3, 3))
    return Trajectory.from_positions(device, "floor", time_ns, position, covariance)


def station(channel: int, x: float, y: float) -> Station:
    return Station(channel, np.array([x, y, 2.0]), ROTATION, IDEAL_CALIBRATION)


SCENE = Scene(
    stations=(station(1, -2.0, 0.0), station(16, 14.0, 3.0)),
    markers=(Marker("corner", np.array([0.5, 0.5, 0.0])),),
    planar=True,
    scale="markers",
)
TRUTH = (track("red"), track("blue"))
LONG_WARNING = SolverWarning("test", "a note that goes on and on " * 30)


def solution(names: tuple[str, ...] = ("red", "blue"), scene: object = SCENE) -> Solution:
    return Solution(
        "lighthouse",
        "bundle",
        tuple(track(name, off_m=2e-3 * (k + 1)) for k, name in enumerate(names)),
        artifact=scene,
        warnings=(
            SolverWarning(
                "generic_calibration",
                "no factory calibration is known: the mean of other units is used",
            ),
        ),
    )


def texts(figure: Figure) -> list[str]:
    return [t.get_text() for t in figure.findobj(Text) if t.get_text()]


# ---- files


@pytest.mark.slow
def test_the_same_arguments_give_the_same_bytes_of_every_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the user's settings nor an earlier file change a picture, and pyplot is not used."""
    # It would choose a window system and keep every figure.
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    heads = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
    assert tuple(heads) == SUFFIXES
    for suffix, head in heads.items():
        first, second = tmp_path / f"a{suffix}", tmp_path / f"b{suffix.upper()}"
        write_picture(first, solution(), truth=TRUTH)
        second.write_text("mine")
        with mpl.rc_context({"axes.facecolor": "red", "font.size": 30, "lines.linewidth": 9}):
            write_picture(second, solution(), truth=TRUTH, overwrite=True)
            assert mpl.rcParams["font.size"] == 30
        assert first.read_bytes().startswith(head)
        assert first.read_bytes() == second.read_bytes(), suffix
    assert struct.unpack(">II", (tmp_path / "a.png").read_bytes()[16:24]) == (1200, 600)
    assert len(list(tmp_path.iterdir())) == 2 * len(heads)


def test_an_existing_file_is_not_replaced_unasked(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_text("mine")
    with pytest.raises(OutputExistsError) as caught:
        write_picture(path, solution())
    assert caught.value.hint
    assert path.read_text() == "mine"


@pytest.mark.parametrize("name", ["a.jpg", "a", ".png", "a.png.txt"])
def test_an_unknown_kind_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="not the name of a picture") as caught:
        write_picture(tmp_path / name, solution())
    assert "\n" not in str(caught.value)
    assert ".png, .svg, .pdf" in str(caught.value.hint)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="nowhere"):
        write_picture(tmp_path / "nowhere" / "a.png", solution())


def test_nothing_is_left_behind_when_drawing_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Figure, stream: object, **_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full)
    with pytest.raises(Exception, match="No space left"):
        write_picture(tmp_path / "a.png", solution())
    assert list(tmp_path.iterdir()) == []


def test_no_module_imports_pyplot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    monkeypatch.delattr(mpl, "pyplot", raising=False)
    modules = [
        module.name for module in pkgutil.iter_modules(plots.__path__, "locatk.formats.plots.")
    ]
    assert "locatk.formats.plots.picture" in modules
    for name in modules:
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.loader is not None
        spec.loader.exec_module(importlib.util.module_from_spec(spec))  # as if for the first time


# ---- contents


def test_errors_are_those_of_the_evaluation() -> None:
    figure = draw_picture(solution(), TRUTH)
    said = "\n".join(texts(figure))
    assert "240 poses of 2 devices" in said
    assert "APE rmse 3.16 mm, mean 3.00 mm" in said  # 2 mm and 4 mm
    assert "alignment: none" in said
    assert "the mean of other units" in said
    assert "error [mm]" in said
    over_time = next(a for a in figure.axes if a.get_ylabel() == "error [mm]")
    points = [line for line in over_time.lines if line.get_linestyle() == "None"]
    shown = np.concatenate([line.get_ydata() for line in points])
    np.testing.assert_allclose(np.unique(np.round(shown, 6)), [2.0, 4.0])


def test_an_alignment_brings_all_into_the_frame_of_the_truth() -> None:
    away = Similarity(0.5, rotation_exp([0.0, 0.0, 1.0]), np.array([3.0, 2.0, 0.0]))
    moved = Solution(
        "lighthouse",
        "bundle",
        tuple(replace(t, position=away.apply(t.position)) for t in TRUTH),
        artifact=replace(
            SCENE,
            scale="unit",
            stations=tuple(
                replace(s, position=away.apply(s.position), rotation=away.rotation @ s.rotation)
                for s in SCENE.stations
            ),
        ),
    )
    pairs = list(zip(moved.trajectories, TRUTH, strict=True))
    figure = draw_picture(moved, TRUTH, evaluate(pairs, EvaluationOptions(align="sim3")))
    ground = figure.axes[0]
    assert ground.get_xlabel() == "x [m]"
    paths = [line.get_xydata() for line in ground.lines if len(line.get_xydata()) == 120]
    assert len(paths) == 4  # two truths, two solutions
    for path in paths:
        np.testing.assert_allclose(path, TRUTH[0].position[:, :2], atol=1e-9)
    dots = [line.get_xydata()[0] for line in ground.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(dots, [[-2.0, 0.0]], atol=1e-9)


def test_without_truth_sigmas_are_shown() -> None:
    said = texts(draw_picture(solution()))
    assert "solver's sigma [mm]" in said
    assert not any("MAE" in text for text in said)


@pytest.mark.slow
def test_a_solution_without_scale_is_not_compared_with_metres() -> None:
    said = texts(draw_picture(solution(scene=replace(SCENE, scale="unit")), TRUTH))
    assert "x [unit]" in said
    assert "truth" not in said
    assert not any("MAE" in text or "[mm]" in text for text in said)


@pytest.mark.slow
def test_truth_of_other_devices_or_times_is_no_error() -> None:
    later = replace(track("red"), time_ns=track("red").time_ns + 10**12)
    for truth in ((track("green"),), (later,)):
        assert "solver's sigma [mm]" in texts(draw_picture(solution(), truth))


def test_stations_are_in_view_or_named_at_the_margin() -> None:
    figure = draw_picture(solution(), TRUTH)
    ground = figure.axes[0]
    (low, high), (bottom, top) = ground.get_xlim(), ground.get_ylim()
    assert low < -2.0
    assert high < 14.0
    labels = {t.get_text(): t.xy for t in ground.texts if t.get_text()}
    assert set(labels) == {"ch 1", "ch 16\n15 m"}
    for x, y in labels.values():
        assert low < x < high
        assert bottom < y < top


@pytest.mark.slow
@pytest.mark.parametrize(
    ("far_m", "said"), [(0.46, "ch 1\n460 mm"), (1.24, "ch 1\n1.2 m"), (87.3, "ch 1\n87 m")]
)
def test_a_small_map_shows_the_distance_of_stations(far_m: float, said: str) -> None:
    small = replace(track("red"), position=0.01 * track("red").position)
    station = Station(1, np.array([0.0, far_m, 0.0]), np.eye(3), IDEAL_CALIBRATION)
    scene = Scene(stations=(station,), scale="markers")
    figure = draw_picture(Solution("lighthouse", "bundle", (small,), artifact=scene))
    assert figure.axes[0].get_xlabel() == "x [mm]"
    assert said in texts(figure)


def test_paths_break_at_gaps() -> None:
    whole = track("red")
    keep = np.r_[0:40, 60:120]
    part = Trajectory.from_positions("red", "floor", whole.time_ns[keep], whole.position[keep])
    figure = draw_picture(Solution("lighthouse", "bundle", (part,), artifact=SCENE))
    x = next(line for line in figure.axes[0].lines if len(line.get_xdata()) > 50).get_xdata()
    assert len(x) == 101
    assert np.flatnonzero(np.isnan(x)).tolist() == [40]


def test_outliers_do_not_hide_the_other_poses() -> None:
    wild = track("red")
    wild.position[50] = [700.0, -300.0, 0.0]
    figure = draw_picture(Solution("lighthouse", "bundle", (wild,), artifact=SCENE), TRUTH)
    assert figure.axes[0].get_xlim()[1] < 10
    said = texts(figure)
    assert "1 pose outside this view" in said
    assert any("1 of 120 beyond this scale (triangles)" in text for text in said)
    assert any("1 of 120 poses beyond this scale are in the last bin" in text for text in said)


@pytest.mark.slow
def test_bounds_beyond_the_scale_are_open_triangles() -> None:
    unsure = track("red", off_m=2e-3)
    unsure.covariance[40:80, :3, :3] *= 1e6
    figure = draw_picture(Solution("lighthouse", "bundle", (unsure,), artifact=SCENE), TRUTH)
    over_time = next(a for a in figure.axes if a.get_ylabel() == "error [mm]")
    assert "open triangles: the line is beyond this scale" in over_time.get_title(loc="left")
    (marks,) = (
        line
        for line in over_time.lines
        if line.get_marker() == "^" and line.get_markerfacecolor() == "none"
    )
    limit = over_time.get_ylim()[1]
    assert limit < 100
    assert 10 < len(marks.get_xdata()) < 40
    assert (marks.get_ydata() < limit).all()


LONG = tuple(f"robot-with-a-very-long-name-{k}" for k in range(30))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shown", "truth"),
    [
        (solution(scene=replace(SCENE, scale="unit")), ()),
        (solution(names=LONG), ()),
        (solution(names=("_hidden", "$5 and $6")), ()),
        (replace(solution(), warnings=(LONG_WARNING,)), TRUTH),
        (Solution("lighthouse", "bundle", (), artifact=SCENE), ()),
        (Solution("lighthouse", "bundle", ()), ()),
        (Solution("lighthouse", "bundle", (track("red", n=0),), artifact=SCENE), TRUTH),
        (Solution("lighthouse", "bundle", (track("red", n=1),)), TRUTH),
        (solution(scene=replace(SCENE, stations=tuple(
            station(k + 1, 9 * np.cos(k / 2.5), 9 * np.sin(k / 2.5)) for k in range(16)
        ))), TRUTH),
    ],
)  # fmt: skip
def test_every_word_is_inside_the_picture(shown: Solution, truth: tuple[Trajectory, ...]) -> None:
    figure = draw_picture(shown, truth)
    figure.draw_without_rendering()
    frame = figure.bbox
    undrawn = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            outside = [t for t in axis.get_major_ticks() if not low <= t.get_loc() <= high]
            undrawn.update(label for t in outside for label in (t.label1, t.label2))
    words = [t for t in figure.findobj(Text) if t.get_text().strip() and t not in undrawn]
    assert len(words) > 10
    for text in words:
        box = text.get_window_extent()
        assert frame.x0 <= box.x0, text
        assert box.x1 <= frame.x1 + 1, text
        assert frame.y0 <= box.y0, text
        assert box.y1 <= frame.y1 + 1, text


@pytest.mark.slow
def test_expected_errors_are_drawn() -> None:
    figure = draw_picture(solution(names=("red",)), TRUTH)
    over_time = next(a for a in figure.axes if a.get_ylabel() == "error [mm]")
    assert (
        over_time.get_title(loc="left")
        == "line: 95 % of errors expected below it, by the covariance"
    )
    edges = [line.get_ydata() for line in over_time.lines if line.get_linestyle() == "-"]
    np.testing.assert_allclose(np.concatenate(edges), 2.7955, rtol=4e-3)  # chi-squared of three
    assert over_time.get_ylim()[1] > 2.8
    many = draw_picture(solution(names=("a", "b", "c", "d")), tuple(track(name) for name in "abcd"))
    assert not any("95 % of errors" in text for text in texts(many))


@pytest.mark.slow
def test_the_title_contains_the_solved_fraction() -> None:
    said = "\n".join(texts(draw_picture(solution(), TRUTH)))
    assert "100.0 % of the time solved" in said
