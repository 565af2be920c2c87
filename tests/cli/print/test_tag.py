"""`locatk print tag` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as Xml

import pypdfium2
import pytest

from locatk.core.polaris.tag import Magnet, Tags
from locatk.formats.artifacts.tags import write_tags


@pytest.fixture
def tag_file(tmp_path: Path) -> Path:
    """Any id may occur."""
    path = tmp_path / "tag.toml"
    write_tags(path, Tags())
    return path


@pytest.fixture
def family_file(tmp_path: Path) -> Path:
    """Thirty members of mini tags."""
    path = tmp_path / "family.toml"
    mini = Tags(
        magnets=3, spacing_m=0.008, magnet=Magnet(1e-3, 0.5e-3), ids=tuple(range(0, 510, 17))
    )
    write_tags(path, mini)
    return path


def words(path: Path) -> str:
    document = pypdfium2.PdfDocument(str(path))
    return "".join(page.get_textpage().get_text_bounded() for page in document)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_tags_that_are_named(locatk, tag_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "tags.pdf"
    result = locatk(
        "print", "tag", tag_file, "--id", 262143, "--id", 5, "-o", out, "--size", "letter"
    )
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"Wrote {out}: 2 tags on 1 page of 279.4 x 215.9 mm\n"
    assert "100 %" in result.stderr
    assert names(tmp_path) == ["tag.toml", "tags.pdf"]
    page = pypdfium2.PdfDocument(str(out))[0]
    size = [side * 25.4 / 72 for side in page.get_size()]
    assert size == pytest.approx([279.4, 215.9], abs=0.05)
    assert "id 262143" in words(out)
    assert "id 5" in words(out)


def test_json_has_the_position_of_each_tag(locatk, tag_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.svg"
    asked = ["--id", 7, "--id", 7, "--id", 8, "-o", out, "--json"]
    result = locatk("print", "tag", tag_file, *asked)
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["version"] == 1
    assert answer["outputs"] == [str(tmp_path / "a-1.svg"), str(tmp_path / "a-2.svg")]
    assert answer["page_mm"] == [210, 297]
    assert [(tag["id"], tag["page"]) for tag in answer["tags"]] == [(7, 1), (7, 1), (8, 2)]
    # v1 and v3 lie opposite to each other about the origin.
    root = Xml.parse(answer["outputs"][1]).getroot()
    circles = root.findall(".//{*}circle")
    (x, y) = answer["tags"][2]["origin_mm"]
    places = {
        (round(float(c.attrib["cx"]) - x, 3), round(297 - float(c.attrib["cy"]) - y, 3))
        for c in circles
    }
    assert {(-40, -40), (-40, 40), (40, 40)} <= places
    assert (40, -40) not in places
    # Two copies of a tag have names of their own.
    first = Xml.parse(answer["outputs"][0]).getroot()
    ids = [group.attrib["id"] for group in first.findall(".//{*}g[@id]")]
    assert ids == ["page", "tag-7", "tag-7-copy-1"]


@pytest.mark.slow
def test_all_members_of_a_family_are_drawn(locatk, family_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "tags.pdf"
    result = locatk("print", "tag", family_file, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert [tag["id"] for tag in answer["tags"]] == list(range(0, 510, 17))
    assert len(pypdfium2.PdfDocument(str(out))) == 2
    assert all(f"id {number}\r" in words(out) for number in range(0, 510, 17))
    stranger = locatk("print", "tag", family_file, "--id", 3, "-o", tmp_path / "b.pdf")
    assert stranger.exit_code == 1
    assert "id 3 is not in the family" in stranger.stderr
    assert str(family_file) in stranger.stderr
    assert not (tmp_path / "b.pdf").exists()


def test_same_input_same_bytes(locatk, family_file: Path, tmp_path: Path) -> None:
    for format_name in ("pdf", "svg"):
        made = []
        for folder in ("a", "b"):
            (tmp_path / folder).mkdir(exist_ok=True)
            out = tmp_path / folder / f"tags.{format_name}"
            result = locatk("print", "tag", family_file, "--id", 17, "-o", out)
            assert result.exit_code == 0, result.stderr
            made.append(out.read_bytes())
        assert made[0] == made[1]


def test_the_ending_or_the_option_selects_the_format(
    locatk, tag_file: Path, tmp_path: Path
) -> None:
    for name, more, head in (
        ("a.svg", [], b"<?xml"),
        ("a.pdf", [], b"%PDF"),
        ("b.svg", ["--format", "svg"], b"<?xml"),
        ("c", ["--format", "pdf"], b"%PDF"),
    ):
        assert (
            locatk("print", "tag", tag_file, "--id", 1, "-o", tmp_path / name, *more).exit_code == 0
        )
        assert (tmp_path / name).read_bytes().startswith(head)


def test_endings_of_other_formats_are_refused(locatk, tag_file: Path, tmp_path: Path) -> None:
    before = names(tmp_path)
    for name, more, words in (
        ("a.svg", ["--format", "pdf"], "end it in .pdf"),
        ("a.pdf", ["--format", "svg"], "end it in .svg"),
        ("a.png", [], "(.pdf, .svg)"),
        ("a.toml", ["--format", "svg"], "end it in .svg"),
        ("a.dxf", [], "(.pdf, .svg)"),
        ("a", [], "(.pdf, .svg)"),
    ):
        result = locatk("print", "tag", tag_file, "--id", 1, "-o", tmp_path / name, *more)
        assert result.exit_code == 2, name
        assert words in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert names(tmp_path) == before


def test_nothing_is_replaced_unasked(locatk, family_file: Path, tmp_path: Path) -> None:
    second = tmp_path / "tags-2.svg"
    second.write_text("mine")
    refused = locatk("print", "tag", family_file, "-o", tmp_path / "tags.svg")
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    assert second.read_text() == "mine"
    assert names(tmp_path) == ["family.toml", "tags-2.svg"]
    done = locatk("print", "tag", family_file, "-o", tmp_path / "tags.svg", "--overwrite")
    assert done.exit_code == 0, done.stderr
    assert names(tmp_path) == ["family.toml", "tags-1.svg", "tags-2.svg"]
    before = family_file.read_bytes()
    (tmp_path / "link.pdf").symlink_to(family_file)
    itself = locatk("print", "tag", family_file, "-o", tmp_path / "link.pdf", "--overwrite")
    assert itself.exit_code == 1
    assert "one of the inputs" in itself.stderr
    assert family_file.read_bytes() == before


@pytest.mark.parametrize(
    ("more", "status", "said"),
    [
        ([], 2, "--id"),
        (["--id", "-1"], 2, "--id"),
        (["--id", 327680], 1, "327680"),
        (["--id", 1, "--size", "A5"], 0, "148 x 210"),
        (["--id", 1, "--size", "90x90mm"], 1, "larger than the paper"),
        (["--id", 1, "--size", "A17"], 1, "A17"),
        (["--id", 1, "--margin", 110], 1, "margin"),
        (["--id", 1, "--size", "200x6000mm"], 1, "--format svg"),
    ],
)
def test_wrong_arguments_are_reported(
    locatk, tag_file: Path, tmp_path: Path, more: list[object], status: int, said: str
) -> None:
    result = locatk("print", "tag", tag_file, "-o", tmp_path / "a.pdf", *more)
    assert result.exit_code == status, result.stderr
    assert said in result.stdout + result.stderr
    assert (tmp_path / "a.pdf").exists() == (status == 0)


def test_a_broken_tag_file_is_named(locatk, tmp_path: Path) -> None:
    missing = locatk("print", "tag", tmp_path / "none.toml", "-o", tmp_path / "a.pdf", "--id", 1)
    assert missing.exit_code == 1
    assert "none.toml" in missing.stderr
    broken = tmp_path / "broken.toml"
    broken.write_text('format = "locatk-tag"\nformat_version = 1\ncodec = "morse"\n')
    result = locatk("print", "tag", broken, "-o", tmp_path / "a.pdf", "--id", 1)
    assert result.exit_code == 1
    assert f"{broken}" in result.stderr
    assert "Traceback" not in result.stderr
