"""locatk site: design, check, import and survey of the positions of tags."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import ezdxf
import pytest

from locatk.core.polaris.simulation.options import SimulationOptions
from locatk.core.polaris.simulation.session import simulate
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.formats.artifacts.tags import read_tags, write_tags
from locatk.formats.sessions.field_samples import write_magnetometers

FAMILY = (0, 202517, 77354, 279871, 154708, 29545)


@pytest.fixture
def tag(tmp_path: Path) -> Path:
    path = tmp_path / "tag.toml"
    write_tags(path, Tags(ids=FAMILY, min_distance=3))
    return path


# ---- design


def test_a_grid_gets_the_ids_of_the_family(locatk, tag: Path, tmp_path: Path) -> None:
    out = tmp_path / "site.toml"
    args = ("--grid", "2x3", "--spacing", 500, "--origin", "100,-200", "--heading", 90)
    result = locatk("site", "design", tag, *args, "-o", out)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith(f"Wrote {out}: 6 tags, ids 0, 29545, 77354, 154708, ...")
    assert "separate passes" in result.stdout
    site = read_tags(out)
    assert site.ids == FAMILY
    assert site.site[FAMILY[5]] == PlanarPose(1.1, 0.3, math.pi / 2)
    again = tmp_path / "again.toml"
    assert locatk("site", "design", tag, *args, "-o", again).exit_code == 0
    assert again.read_bytes() == out.read_bytes()
    refused = locatk("site", "design", tag, *args, "-o", out)
    assert refused.exit_code == 1
    assert "output exists" in refused.stderr
    assert locatk("site", "design", tag, *args, "-o", out, "--overwrite").exit_code == 0


def test_a_site_with_findings_is_written_with_status_3(locatk, tag: Path, tmp_path: Path) -> None:
    out = tmp_path / "site.toml"
    result = locatk("site", "design", tag, "--grid", "1x3", "--spacing", 150, "-o", out, "--json")
    assert result.exit_code == 3
    entry = json.loads(result.stdout)
    assert [finding["code"] for finding in entry["findings"]] == ["row"]
    assert [each["x_m"] for each in entry["site"]] == [0.0, 0.3, 0.15]
    assert "at most 2 tags in a pass" in result.stderr
    assert len(read_tags(out).site) == 3


def test_points_and_routes_of_tables(locatk, tag: Path, tmp_path: Path) -> None:
    points, out = tmp_path / "points.csv", tmp_path / "site.toml"
    points.write_text("x,y,id,meaning\n0,0,,dock\n1.2,0,77354,stop\n")
    args = ("--units", "m", "--heading", 45, "-o", out)
    assert locatk("site", "design", tag, "--points", points, *args).exit_code == 0
    site = read_tags(out)
    assert site.site[77354] == PlanarPose(1.2, 0.0, math.pi / 4)
    assert site.meanings == {0: "dock", 77354: "stop"}
    route = tmp_path / "route.csv"
    route.write_text("x_mm,y_mm\n0,0\n1000,0\n1000,1000\n0,10\n")
    args = ("--route", route, "--spacing", 800, "-o", out, "--overwrite", "--json")
    result = locatk("site", "design", tag, *args)
    assert result.exit_code == 0, result.stderr
    poses = [(each["x_m"], each["y_m"]) for each in json.loads(result.stdout)["site"]]
    assert sorted(poses)[0] == (0.0, 0.0)
    assert len(poses) == 6
    assert "1 point at which the route passes a tag again: left out" in result.stderr


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ((), "Give one of --grid, --points and --route."),
        (("--grid", "2x2"), "--grid and --route need --spacing."),
        (("--grid", "2x2", "--route", "tag.toml", "--spacing", 9), "Give one of"),
        (("--grid", "2", "--spacing", 9), "is not rows x columns"),
        (("--points", "tag.toml", "--spacing", 9), "not for --points"),
        (("--grid", "2x2", "--spacing", 9, "--units", "m"), "--columns and --units are for"),
        (("--grid", "2x2", "--spacing", 9, "--origin", "1"), "is not x,y in mm"),
        (("--points", "none.csv"), "No such file"),
        (("--grid", "2x2", "--accuracy", 9), "--accuracy is for --route"),
        (("--grid", "2x2", "--spacing", 9, "--drift", 1), "are for --accuracy"),
        (("--route", "tag.toml", "--accuracy", "9,x"), "is not MM or MM,DEG"),
        (("--route", "tag.toml", "--accuracy", "-9"), "in mm and degrees"),
        (("--grid", "2x2", "--spacing", 900, "--environment", "loud"), "environment 'loud'"),
        (("--grid", "3x3", "--spacing", 500), "9 positions, but only 6 ids"),
    ],
)
def test_wrong_use_of_design(locatk, tag: Path, monkeypatch, args: tuple, words: str) -> None:
    monkeypatch.chdir(tag.parent)
    result = locatk("site", "design", tag.name, *args, "-o", "site.toml")
    assert result.exit_code in (1, 2)
    assert words in " ".join(result.stderr.split())
    assert not Path("site.toml").exists()


# ---- routes

AISLE = "x_mm,y_mm\n0,0\n3000,0\n3000,1500\n"


@pytest.fixture
def aisle(tmp_path: Path) -> Path:
    path = tmp_path / "aisle.csv"
    path.write_text(AISLE)
    return path


@pytest.mark.slow
def test_a_route_with_an_accuracy_is_designed_and_checked(
    locatk, tmp_path: Path, aisle: Path
) -> None:
    tag, out = tmp_path / "any.toml", tmp_path / "site.toml"
    write_tags(tag, Tags())
    args = ("--route", aisle, "--accuracy", "15,2", "-o", out, "--json")
    result = locatk("site", "design", tag, *args)
    assert result.exit_code == 0, result.stderr
    entry = json.loads(result.stdout)
    assert entry["spacing"]["is_feasible"]
    assert entry["forecast"]["position_p95_m"] <= 0.015
    assert entry["forecast"]["heading_p95_rad"] <= math.radians(2)
    assert entry["forecast"]["tags"] == len(read_tags(out).site) == entry["tags"]
    check = locatk("site", "check", out, "--route", aisle)
    assert check.exit_code == 0, check.stderr
    assert "error on the route" in check.stdout
    assert all(len(line) <= 80 for line in check.stdout.splitlines())
    better = locatk("site", "check", out, "--route", aisle, "--drift", 0.2, "--slip", 0.1, "--json")
    errors = json.loads(better.stdout)["forecast"]
    assert errors["position_p95_m"] < entry["forecast"]["position_p95_m"]
    surveyed = locatk("site", "check", out, "--route", aisle, "--laying", "0.1,0.05", "--json")
    errors = json.loads(surveyed.stdout)["forecast"]
    assert errors["fix_position_p95_m"] < 0.2 * entry["forecast"]["fix_position_p95_m"]


def test_an_impossible_accuracy_is_answered_with_status_3(
    locatk, tmp_path: Path, aisle: Path
) -> None:
    free, out = tmp_path / "any.toml", tmp_path / "site.toml"
    write_tags(free, Tags())
    result = locatk("site", "design", free, "--route", aisle, "--accuracy", 1, "-o", out)
    assert result.exit_code == 3
    assert "1 mm (95 %) is impossible on this route: tags 249 mm apart give" in result.stderr
    assert "locatk site survey" in result.stderr
    assert read_tags(out).site
    beside = tmp_path / "beside.csv"
    beside.write_text("x_mm,y_mm\n0,500\n2900,500\n")
    missed = locatk("site", "check", out, "--route", beside)
    assert missed.exit_code == 3
    assert "on route beside, no tag passes wholly below the array" in missed.stderr


def test_a_family_with_too_few_ids_is_answered_with_status_3(
    locatk, tmp_path: Path, tag: Path, aisle: Path
) -> None:
    out = tmp_path / "site.toml"
    result = locatk("site", "design", tag, "--route", aisle, "--accuracy", 5, "-o", out)
    assert result.exit_code == 3
    assert "tags are needed, but there are 6 ids: design more" in result.stderr
    assert not out.exists()


def test_a_narrow_array_is_answered_with_status_3(locatk, tmp_path: Path, aisle: Path) -> None:
    free = tmp_path / "any.toml"
    write_tags(free, Tags())
    options = ("--route", aisle, "--accuracy", 9, "--sensors", 4, "-o", tmp_path / "site.toml")
    result = locatk("site", "design", free, *options)
    assert result.exit_code == 3
    assert "no tag passes wholly below the array" in result.stderr
    assert "take a wider array, of" in result.stderr


@pytest.mark.parametrize(
    ("end", "reason"), [("100,0", "no tag is passed straight"), ("9e6,0", "too many tags")]
)
def test_a_route_too_short_or_too_long_is_answered_with_status_3(
    locatk, tmp_path: Path, end: str, reason: str
) -> None:
    free, route = tmp_path / "any.toml", tmp_path / "route.csv"
    write_tags(free, Tags())
    route.write_text(f"x_mm,y_mm\n0,0\n{end}\n")
    options = ("--route", route, "--accuracy", 9, "-o", tmp_path / "site.toml")
    result = locatk("site", "design", free, *options)
    assert result.exit_code == 3
    assert reason in result.stderr


# ---- check


def test_check_reports_bounds_and_meanings(locatk, tag: Path) -> None:
    site = {0: PlanarPose(0.0, 0.0, 0.0), 77354: PlanarPose(1.0, 0.0, 0.0)}
    tags = Tags(ids=FAMILY, min_distance=3, site=site, meanings={0: "dock", 29545: "gone"})
    write_tags(tag, tags, overwrite=True)
    result = locatk("site", "check", tag, "--bounds", "-100,-100,1030,100", "--json")
    assert result.exit_code == 3
    entry = json.loads(result.stdout)
    assert [finding["code"] for finding in entry["findings"]] == ["out_of_bounds", "meaning"]
    assert entry["findings"][0]["ids"] == [77354]
    assert entry["nearest_m"] == 1.0
    assert "d 29545 means 'gone', but is not on the site" in result.stderr
    write_tags(tag, replace(tags, meanings={}), overwrite=True)
    good = locatk("site", "check", tag, "--bounds", "-100,-100,1100,100")
    assert good.exit_code == 0, good.stderr
    assert "nearest tags     0 and 77354, 1000 mm apart" in good.stdout
    assert locatk("site", "check", tag, "--bounds", "0,0,0,1").exit_code == 2
    assert "add --route" in locatk("site", "check", tag, "--drift", 1).stderr
    write_tags(tag, Tags(), overwrite=True)
    assert "no tag has a position" in locatk("site", "check", tag).stderr


# ---- import


def test_import_of_a_survey(locatk, tag: Path, tmp_path: Path) -> None:
    survey, out = tmp_path / "survey.csv", tmp_path / "site.toml"
    survey.write_text("id,east_cm,north_cm,heading_deg\n77354,120,-30,90\n,0,0,\n")
    result = locatk(
        "site", "import", survey, "--tag", tag, "-o", out, "--columns", "x=east_cm,y=north_cm"
    )
    assert result.exit_code == 0, result.stderr
    assert "1 of them had no id" in result.stderr
    assert read_tags(out).site == {
        0: PlanarPose(0.0, 0.0, 0.0),
        77354: PlanarPose(1.2, -0.3, math.pi / 2),
    }
    survey.write_text("id,x_mm,y_mm\n77354,0,0\n77354,900,0\n")
    twice = locatk("site", "import", survey, "--tag", tag, "-o", out, "--overwrite")
    assert twice.exit_code == 1
    assert "survey.csv: line 3: id 77354 is also at line 2" in twice.stderr
    junk = tmp_path / "junk.csv"
    junk.write_bytes(bytes(range(256)))
    assert locatk("site", "import", junk, "--tag", tag, "-o", tmp_path / "x.toml").exit_code == 1


def test_import_of_a_layout(locatk, tag: Path, tmp_path: Path) -> None:
    layout, out = tmp_path / "layout.json", tmp_path / "site.toml"
    nodes = [
        {"nodeId": f"n{k}", "nodeName": name, "nodePosition": {"x": k, "y": 0.0}}
        for k, name in enumerate(("dock", "shelf 1"))
    ]
    layout.write_text(json.dumps({"layouts": [{"nodes": nodes, "edges": []}]}))
    args = ("--tag", tag, "-o", out, "--heading", 180, "--json")
    result = locatk("site", "import", layout, *args)
    assert result.exit_code == 0, result.stderr
    entry = json.loads(result.stdout)
    assert entry["assigned_ids"] == 2
    assert [each["meaning"] for each in entry["site"]] == ["dock", "shelf 1"]
    assert read_tags(out).site[202517].heading_rad == math.pi
    wrong = locatk("site", "import", layout, "--units", "m", "--tag", tag, "-o", out)
    assert wrong.exit_code == 2
    assert "--columns and --units are of --format csv" in wrong.stderr


# ---- survey


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Drives over a triangle of tags."""
    folder = tmp_path_factory.mktemp("drives")
    site = {
        0: PlanarPose(0.0, 0.0, 0.4),
        202517: PlanarPose(0.6, 0.0, 1.0),
        77354: PlanarPose(0.3, 0.5, -2.0),
    }
    tags = Tags(ids=FAMILY, min_distance=3, site=site, meanings={77354: "stop"})
    paths = []
    for seed, route in enumerate(((0, 202517, 77354, 0), (77354, 0, 202517, 77354))):
        options = SimulationOptions(route=route, odometry=True, seed=seed, speed_mps=0.2)
        session = simulate(tags, options)
        assert session.odometry is not None
        paths.append(folder / f"run{seed}.mcap")
        write_magnetometers(
            paths[-1],
            [session.samples],
            tags=replace(tags, site={}),
            odometry=[session.odometry],
        )
    return paths


@pytest.mark.slow
def test_survey_of_recordings(locatk, recordings: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "site.toml"
    result = locatk("site", "survey", *recordings, "-o", out)
    assert result.exit_code == 0, result.stderr
    text = " ".join(result.stdout.split())
    assert "frame: tag 0 is at the origin, with its x along the x of the site" in text
    assert "odometry of bar: " in text
    assert "stop" in text
    assert "2 drives: with three or more" in result.stderr
    site = read_tags(out)
    assert site.site[0] == PlanarPose(0.0, 0.0, 0.0)
    assert math.hypot(site.site[202517].x_m, site.site[202517].y_m) == pytest.approx(0.6, abs=0.03)
    assert site.site_sigma[202517][0] > 1e-3
    # Poses on the surveyed site contain the uncertainty of its tags.
    solved = tmp_path / "solved.mcap"
    result = locatk("solve", recordings[0], "--artifact", out, "-o", solved)
    assert result.exit_code == 0, result.stderr
    table = tmp_path / "poses.csv"
    assert locatk("export", solved, "--format", "csv", "-o", table).exit_code == 0
    rows = [line.split(",") for line in table.read_text().splitlines()]
    sigma = [float(row[rows[0].index("sigma_x_m")]) for row in rows[1:]]
    assert min(sigma) < 1e-3 < max(sigma)
    args = ("-o", out, "--overwrite", "--fix-start", "--json")
    entry = json.loads(locatk("site", "survey", *recordings, *args).stdout)
    assert entry["frame"].startswith("the array is at the origin at the start of ")
    assert not any(each["fixed"] for each in entry["tags"])
    assert len(entry["tags"][0]["covariance"]) == 3


@pytest.mark.slow
def test_sessions_that_cannot_be_used_are_named(
    locatk, recordings: list[Path], tmp_path: Path
) -> None:
    out, junk = tmp_path / "site.toml", tmp_path / "junk.mcap"
    junk.write_bytes(b"no session")
    result = locatk("site", "survey", *recordings, junk, recordings[0], "-o", out)
    assert result.exit_code == 3
    assert "junk.mcap: " in result.stderr
    assert "the same measurements as in" in result.stderr
    both = locatk("site", "survey", recordings[0], "-o", out, "--fix", 0, "--fix-start")
    assert both.exit_code == 2
    unknown = locatk("site", "survey", recordings[0], "-o", out, "--overwrite", "--fix", 9)
    assert unknown.exit_code == 1
    assert "tag 9 was not passed" in unknown.stderr


# ---- export


@pytest.fixture
def site(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    poses = {0: PlanarPose(0.0, 0.0, 0.0), 77354: PlanarPose(1.2, -0.3, math.pi / 2)}
    write_tags(path, Tags(ids=FAMILY, min_distance=3, site=poses, meanings={0: "dock"}))
    return path


@pytest.mark.parametrize(
    ("file", "format_name", "head"),
    [
        ("s.csv", "csv", b"id,x_mm,y_mm,heading_deg,meaning\n0,0,0,0,dock\n"),
        ("s.json", "lif", b'{\n "metaInformation"'),
        ("s.svg", "svg", b"<?xml"),
        ("s.dxf", "dxf", b"  0\nSECTION"),
    ],
)
def test_every_format_of_an_export(
    locatk, site: Path, tmp_path: Path, file: str, format_name: str, head: bytes
) -> None:
    out = tmp_path / file
    result = locatk("site", "export", site, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    entry = json.loads(result.stdout)
    assert (entry["format"], entry["outputs"]) == (format_name, [str(out)])
    assert [each["id"] for each in entry["site"]] == [0, 77354]
    assert out.read_bytes().startswith(head)
    plain = tmp_path / "plain"
    asked = locatk("site", "export", site, "-o", plain, "--format", format_name)
    assert asked.stdout == f"Wrote {plain}: 2 tags\n"
    assert plain.read_bytes() == out.read_bytes()
    again = locatk("site", "export", site, "-o", out)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr


@pytest.mark.parametrize(
    ("file", "more"), [("s.csv", []), ("s.json", []), ("s.json", ["--lif-version", "2.0.0"])]
)
def test_export_and_import_give_the_same_site(
    locatk, site: Path, tag: Path, tmp_path: Path, file: str, more: list[str]
) -> None:
    there, back = tmp_path / file, tmp_path / "back.toml"
    assert locatk("site", "export", site, "-o", there, *more).exit_code == 0
    assert locatk("site", "import", there, "--tag", tag, "-o", back).exit_code == 0
    assert back.read_bytes() == site.read_bytes()


def test_exports_that_are_refused(locatk, site: Path, tag: Path, tmp_path: Path) -> None:
    for args, status, words in (
        ((site, "-o", tmp_path / "a.txt"), 2, "not a known format"),
        ((site, "-o", tmp_path / "a.csv", "--lif-version", "2.0.0"), 2, "is of --format lif"),
        ((tag, "-o", tmp_path / "a.csv"), 1, "no tag has a position"),
    ):
        result = locatk("site", "export", *args)
        assert result.exit_code == status
        assert words in result.stderr
    assert not list(tmp_path.glob("a.*"))


# ---- drawings


def test_import_of_a_drawing(locatk, site: Path, tag: Path, tmp_path: Path) -> None:
    plan, back = tmp_path / "plan.dxf", tmp_path / "back.toml"
    assert locatk("site", "export", site, "-o", plan).exit_code == 0
    result = locatk("site", "import", plan, "--tag", tag, "-o", back)
    assert result.exit_code == 0, result.stderr
    assert f"Lengths in {plan} are in mm." in result.stderr
    assert back.read_bytes() == site.read_bytes()
    args = ("--layer", "centres", "--layer", "LABELS", "--heading", 30, "--units", "m", "--json")
    result = locatk("site", "import", plan, *args, "--tag", tag, "-o", back, "--overwrite")
    assert result.exit_code == 0, result.stderr
    first, second = json.loads(result.stdout)["site"]
    assert (first["id"], first["meaning"], first["x_m"]) == (0, "dock", 0.0)
    assert (second["id"], second["x_m"], second["y_m"]) == (77354, 1200.0, -300.0)
    assert second["heading_rad"] == pytest.approx(math.radians(30))


def test_drawings_and_options_that_are_refused(
    locatk, site: Path, tag: Path, tmp_path: Path
) -> None:
    plan, survey = tmp_path / "plan.dxf", tmp_path / "survey.csv"
    document = ezdxf.new("R12")
    for _ in range(2):
        document.modelspace().add_point((0, 0), {"layer": "TAGS"})
    for name in ("TAG_0", "TAG_000"):
        document.blocks.new(name)
        document.modelspace().add_blockref(name, (1, 1), {"layer": "TWICE"})
    document.saveas(plan)
    survey.write_text("x_mm,y_mm\n0,0\n")
    for args, status, words in (
        (
            (plan,),
            1,
            "plan.dxf: the drawing has no unit ($INSUNITS). Hint: Give it as in --units",
        ),
        ((plan, "--units", "yd"), 2, "--units of a drawing is one of mm, cm, dm, m, in, ft"),
        ((plan, "--units", "m,deg"), 2, "--units of a drawing is one of"),
        ((plan, "--columns", "x=a"), 2, "--columns and --units are of --format csv"),
        ((plan, "--units", "m", "--layer", "TWICE"), 1, ": id 0 is also at handle"),
        ((survey, "--layer", "A"), 2, "--layer is of --format dxf, not of csv"),
    ):
        result = locatk("site", "import", *args, "--tag", tag, "-o", tmp_path / "x.toml")
        assert result.exit_code == status, args
        assert words in result.stderr
    assert not (tmp_path / "x.toml").exists()
