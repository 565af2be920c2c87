"""The ending of an output and its format agree, or nothing is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from locatk.cli import export


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from click.testing import CliRunner

    from locatk.cli.app import app

    folder = tmp_path_factory.mktemp("endings")
    run, out = folder / "run.mcap", folder / "solved.mcap"
    for words in (
        ["simulate", "lighthouse", "-o", str(run), "--duration", "10"],
        ["solve", str(run), "-o", str(out)],
    ):
        assert CliRunner().invoke(app, words).exit_code == 0
    return out


@pytest.mark.parametrize("form", export.ENDINGS)
def test_export_refuses_other_endings(locatk, solved: Path, tmp_path: Path, form: str) -> None:
    others = {ending for endings in export.ENDINGS.values() for ending in endings}
    for ending in sorted(others - set(export.ENDINGS[form])) + [".xyz"]:
        out = tmp_path / f"poses{ending}"
        result = locatk("export", solved, "--format", form, "-o", out)
        assert result.exit_code == 2
        assert f"end it in {export.ENDINGS[form][0]}" in result.stderr
        assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
    for ending in ("", export.ENDINGS[form][0].upper()):
        if form in ("csv", "tum", "kitti"):
            out = tmp_path / f"poses{ending}"
            assert (
                locatk("export", solved, "--format", form, "-o", out, "--overwrite").exit_code == 0
            )


@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "lighthouse", "-o", "x.csv"),
        ("simulate", "dots", "-o", "x.toml"),
        ("solve", "run.mcap", "-o", "x.csv"),
        ("solve", "run.mcap", "-o", "x.mcap", "--save-scene", "scene.mcap"),
        ("recover", "run.mcap", "-o", "x.json"),
        ("decode", "run.mcap", "-o", "x.csv"),
        ("capture", "loop://", "-o", "x.csv"),
        ("calibrate", "scene", "run.mcap", "-o", "x.mcap"),
        ("map", "design", "4x4", "-o", "map.csv"),
        ("tag", "design", "-o", "tag.toml", "--bom", "parts.xlsx"),
        ("emulate", "dots", "--save", "x.png"),
        ("report", "solved.mcap", "-o", "x.csv"),
        ("demo", "lighthouse", "-o", "x.pdf"),
        ("map", "export", "map.toml", "-o", "map.png"),
        ("map", "export", "map.toml", "--format", "csv", "-o", "map.svg"),
    ],
)
def test_other_commands(
    locatk, solved: Path, tmp_path: Path, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run.mcap").write_bytes((solved.parent / "run.mcap").read_bytes())
    (tmp_path / "solved.mcap").write_bytes(solved.read_bytes())
    (tmp_path / "map.toml").write_text("")
    before = sorted(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    result = locatk(*words)
    assert result.exit_code == 2
    assert (
        ("end it in" in result.stderr)
        or ("Use one of" in result.stderr)
        or ("is not a known format" in result.stderr)
    )
    assert sorted(tmp_path.iterdir()) == before
