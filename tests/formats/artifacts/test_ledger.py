"""The ledger on the disk, and what an interrupted print job leaves behind."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.dots.codec import SECTION_LENGTH
from locatk.core.dots.design.ledger import Area, plan
from locatk.core.dots.drawing.layout import lay_out, snap
from locatk.core.errors import ArtifactError, InputError, MissingDataError, OutputExistsError
from locatk.formats.artifacts.ledger import LEDGER_FILE, Ledger, open_ledger
from locatk.formats.artifacts.sheets import read_manifest
from locatk.formats.printing.job import publish

FIRST = Area("A4-0001", "anoto", (0, 0), (0, 0), (374, 545))
SECOND = Area("hall", "libdots", (24, 32), (1330, 7200), (721, 932))


def held(path: Path) -> tuple[Area, ...]:
    with open_ledger(path) as book:
        return book.areas


def test_areas_come_back(tmp_path: Path) -> None:
    path = tmp_path / LEDGER_FILE
    assert held(path) == ()
    assert not path.exists()
    with open_ledger(path) as book:
        book.add([FIRST])
        book.add([SECOND])
    assert held(path) == (FIRST, SECOND)
    before = path.read_bytes()
    with open_ledger(path) as book:
        book.add([FIRST])  # printed once more
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


AREAS = st.builds(
    Area,
    st.uuids().map(str),
    st.sampled_from(["anoto", "libdots", "microdots"]),
    st.tuples(st.integers(0, 62), st.integers(0, 62)),
    st.tuples(st.integers(0, SECTION_LENGTH - 5000), st.integers(0, SECTION_LENGTH - 5000)),
    st.tuples(st.integers(1, 5000), st.integers(1, 5000)),
)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(st.lists(AREAS, max_size=5))
def test_any_areas_come_back(tmp_path_factory: pytest.TempPathFactory, areas: list[Area]) -> None:
    path = tmp_path_factory.mktemp("ledger") / LEDGER_FILE
    with open_ledger(path) as book:
        book.add(areas)
    assert held(path) == tuple(areas)


@pytest.mark.parametrize(
    ("find", "put", "where"),
    [
        ("locatk-dot-ledger", "locatk-dot-sheets", "format"),
        ("format_version = 1", "format_version = 99", "format_version"),
        ("size = [374, 545]", "", "areas[0]"),
        ("size = [374, 545]", "size = [374]", "areas[0].size"),
        ("size = [374, 545]", "size = [374, 545.5]", "areas[0].size"),
        ("size = [374, 545]", "size = [374, 0]", "areas[0].origin"),
        ("origin = [0, 0]", "origin = [-1, 0]", "areas[0].origin"),
        ("section = [0, 0]", "section = [0, 63]", "areas[0].origin"),
        ("section = [0, 0]", "section = [0, 0]\nplace = 1", "areas[0]"),
        ('id = "hall"', 'id = "A4-0001"', "areas[1].id"),
        ("[[areas]]", "[[areas", "areas"),
    ],
)
def test_a_damaged_ledger_is_refused_and_not_changed(
    tmp_path: Path, find: str, put: str, where: str
) -> None:
    path = tmp_path / LEDGER_FILE
    with open_ledger(path) as book:
        book.add([FIRST, SECOND])
    damaged = path.read_text().replace(find, put, 1)
    path.write_text(damaged)
    with pytest.raises(ArtifactError) as caught, open_ledger(path):
        pass
    assert caught.value.file == str(path)
    assert where == "areas" or str(caught.value.where) == where
    assert path.read_text() == damaged


@pytest.mark.parametrize("content", [b"", b"\x00\xff\x12", b"format = ", b"%PDF-1.6\n"])
def test_other_files_are_refused_and_not_changed(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / LEDGER_FILE
    path.write_bytes(content)
    with pytest.raises(ArtifactError), open_ledger(path):
        pass
    assert path.read_bytes() == content


def test_folders_without_a_ledger(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError), open_ledger(tmp_path / "none" / LEDGER_FILE):
        pass
    with pytest.raises(OutputExistsError), open_ledger(tmp_path):
        pass


def test_a_ledger_that_changed_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    """As when two computers print with one ledger on a network disk that cannot lock."""
    path = tmp_path / LEDGER_FILE
    mine, other = Ledger(path), Ledger(path)
    other.add([FIRST])
    with pytest.raises(InputError, match="changed"):
        mine.add([SECOND])
    assert held(path) == (FIRST,)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="locks of POSIX")
def test_simultaneous_runs_take_different_areas(tmp_path: Path) -> None:
    code = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from locatk.core.dots.design.ledger import allocate\n"
        "from locatk.formats.artifacts.ledger import open_ledger\n"
        "with open_ledger(Path(sys.argv[1])) as book:\n"
        "    new = allocate(book.areas, [(100, 100)], prefixes=['A4'], codec='anoto')\n"
        "    time.sleep(0.05)\n"
        "    book.add(new)\n"
    )
    path = tmp_path / LEDGER_FILE
    runs = [subprocess.Popen([sys.executable, "-c", code, str(path)]) for _ in range(4)]
    assert [run.wait(timeout=60) for run in runs] == [0, 0, 0, 0]
    areas = held(path)
    assert [area.id for area in areas] == ["A4-0001", "A4-0002", "A4-0003", "A4-0004"]
    assert len({area.origin for area in areas}) == 4


def job(
    folder: Path, writers: list[Callable[[IO[bytes]], object]], overwrite: bool = False
) -> None:
    """Print as many sheets as there are writers."""
    one = lay_out((148, 210), 10, snap(0.508, None, 300))
    with open_ledger(folder / LEDGER_FILE) as book:
        areas, manifest = plan([one] * len(writers), book.areas, codec="anoto")
        publish(
            [(folder / f"out{n}", write) for n, write in enumerate(writers)],
            folder / "out.toml",
            manifest,
            book,
            areas,
            overwrite=overwrite,
        )


def test_a_job_leaves_sheets_manifest_and_ledger(tmp_path: Path) -> None:
    job(tmp_path, [lambda stream: stream.write(b"one"), lambda stream: stream.write(b"two")])
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        LEDGER_FILE, "out.toml", "out0", "out1",
    ]  # fmt: skip
    assert (tmp_path / "out1").read_bytes() == b"two"
    made = read_manifest(tmp_path / "out.toml")
    assert [(s.id, s.origin, s.size) for s in made.sheets] == [
        (area.id, area.origin, area.size) for area in held(tmp_path / LEDGER_FILE)
    ]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(143), OSError("full")])
def test_an_interrupt_while_drawing_leaves_nothing(tmp_path: Path, error: BaseException) -> None:
    def stop(stream: IO[bytes]) -> None:
        stream.write(b"half")
        raise error

    with pytest.raises(BaseException):  # noqa: B017, PT011
        job(tmp_path, [lambda stream: stream.write(b"one"), stop])
    assert list(tmp_path.iterdir()) == []


def test_no_sheet_appears_before_its_area(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order in which files take their names: ledger, manifest, sheets."""
    from locatk.formats import output

    seen: list[list[str]] = []

    def record(real: Callable[[Path, Path], None]) -> Callable[[Path, Path], None]:
        def move(part: Path, target: Path) -> None:
            real(part, target)
            seen.append(sorted(p.name for p in tmp_path.iterdir() if p.suffix != ".part"))

        return move

    monkeypatch.setattr(output, "_move_to_free_name", record(output._move_to_free_name))
    monkeypatch.setattr(output.os, "replace", record(output.os.replace))
    job(tmp_path, [lambda stream: stream.write(b"one")])
    assert seen == [
        [LEDGER_FILE],
        [LEDGER_FILE, "out.toml"],
        [LEDGER_FILE, "out.toml", "out0"],
    ]


def test_existing_sheets_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "out1").write_bytes(b"mine")
    writers: list[Callable[[IO[bytes]], object]] = [lambda stream: stream.write(b"one")] * 2
    with pytest.raises(OutputExistsError):
        job(tmp_path, writers)
    assert [path.name for path in tmp_path.iterdir()] == ["out1"]
    job(tmp_path, writers, overwrite=True)
    assert (tmp_path / "out1").read_bytes() == b"one"
