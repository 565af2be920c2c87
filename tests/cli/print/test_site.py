"""`locatk print site` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

import pypdfium2
import pytest

from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.formats.artifacts.tags import write_tags


@pytest.fixture
def site(tmp_path: Path) -> Path:
    path = tmp_path / "hall.toml"
    poses = {5: PlanarPose(0.0, 0.0, 0.0), 77354: PlanarPose(1.2, -0.3, 1.0)}
    write_tags(path, Tags(site=poses, meanings={5: "dock"}))
    return path


def words(path: Path) -> str:
    document = pypdfium2.PdfDocument(str(path))
    return "".join(page.get_textpage().get_text_bounded() for page in document)


def test_plan_and_table(locatk, site: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan.pdf"
    result = locatk("print", "site", site, "-o", out, "--paper", "letter", "--json")
    assert result.exit_code == 0, result.stderr
    entry = json.loads(result.stdout)
    assert sorted(entry["page_mm"]) == [215.9, 279.4]
    assert (entry["pages"], entry["parts"]) == (2, {"plan": [1, 1], "table": [2, 2]})
    assert entry["tags"] == [{"id": 5, "page": 1}, {"id": 77354, "page": 1}]
    assert entry["datum_mm"] == [0.0, 0.0]
    page = pypdfium2.PdfDocument(str(out))[0]
    size = [side * 25.4 / 72 for side in page.get_size()]
    assert size == pytest.approx(entry["page_mm"], abs=0.05)
    text = words(out)
    assert "hall: plan of the tags" in text
    assert "dock" in text
    assert "77354" in text
    again = tmp_path / "again.pdf"
    plain = locatk("print", "site", site, "-o", again, "--size", "Letter")
    assert plain.stdout.startswith(f"Wrote {again}: 2 tags on 2 pages of ")
    assert "100 %" in plain.stderr
    assert again.read_bytes() == out.read_bytes()


def test_positions_from_another_datum(locatk, site: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan.pdf"
    assert locatk("print", "site", site, "-o", out, "--datum=-500,250").exit_code == 0
    assert "1700" in words(out)
    assert "-550" in words(out)


def test_plans_that_are_refused(locatk, site: Path, tmp_path: Path) -> None:
    bare = tmp_path / "tag.toml"
    write_tags(bare, Tags())
    for args, status, text in (
        ((bare, "-o", tmp_path / "a.pdf"), 1, "no tag has a position"),
        ((site, "-o", tmp_path / "a.svg"), 2, ".pdf"),
        ((site, "-o", tmp_path / "a.pdf", "--paper", "A5", "--margin", 50), 1, "a margin of 50"),
        ((site, "-o", tmp_path / "a.pdf", "--datum", "left"), 2, "is not x,y in mm"),
    ):
        result = locatk("print", "site", *args)
        assert result.exit_code == status, args
        assert text in result.stderr
    assert not list(tmp_path.glob("a.*"))
