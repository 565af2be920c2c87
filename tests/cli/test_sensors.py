"""``locatk array|halls|receiver design``: layouts of sensors, and their drawings."""

from __future__ import annotations

import json
import xml.etree.ElementTree as Xml
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from locatk.cli.app import app
from locatk.core.lighthouse.receiver import DECK
from locatk.core.polaris.mlx90393 import Settings, published_bar
from locatk.formats.artifacts.maps import read_halls
from locatk.formats.artifacts.receiver import read_receiver
from locatk.formats.artifacts.tags import read_array

SVG = "{http://www.w3.org/2000/svg}"


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def test_board_of_the_authors(tmp_path: Path) -> None:
    result = run("array", "design", "--board", "polaris-3", "-o", tmp_path / "a.toml")
    assert result.exit_code == 0, result.output
    array = read_array(tmp_path / "a.toml")
    expected = published_bar(3, 0.008, Settings(filt=5))
    np.testing.assert_allclose(array.position_m, expected.position_m, atol=1e-12)
    np.testing.assert_allclose(array.quantum_t, expected.quantum_t)
    np.testing.assert_allclose(array.delay_s, expected.delay_s)


def test_grid_counts_left_then_back(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    result = run("array", "design", "--grid", "2x3", "--pitch", 10, "--noise", 0.5, "-o", path)
    assert result.exit_code == 0, result.output
    array = read_array(path)
    expected = [[5, -10], [5, 0], [5, 10], [-5, -10], [-5, 0], [-5, 10]]
    np.testing.assert_allclose(array.position_m[:, :2] * 1e3, expected, atol=1e-9)
    np.testing.assert_allclose(array.noise_t, 0.5e-6)
    assert np.isinf(array.range_t).all()


def test_grid_of_one_row_is_the_bar_of_the_authors(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    words = ("--grid", "1x9", "--pitch", 20, "--mlx90393", "default", "--range", 5000)
    result = run("array", "design", *words, "-o", path)
    assert result.exit_code == 0, result.output
    array = read_array(path)
    np.testing.assert_allclose(array.position_m, published_bar().position_m, atol=1e-12)
    np.testing.assert_allclose(array.noise_t, published_bar().noise_t)
    np.testing.assert_allclose(array.range_t, 5e-3)


def test_halls_on_a_circle_and_from_a_table(tmp_path: Path) -> None:
    circle, table = tmp_path / "circle.toml", tmp_path / "table.toml"
    words = ("--circle", 25, "--range", 42, "--noise", 30)
    result = run("halls", "design", *words, "-o", circle, "--json")
    assert result.exit_code == 0, result.output
    entry = json.loads(result.stdout)
    assert entry["sensors"][1] == {"name": "left", "position_mm": [0.0, 25.0]}
    halls = read_halls(circle)
    assert halls.names == ("front", "left", "rear", "right")
    assert (halls.range_t, halls.noise_t) == pytest.approx((42e-3, 30e-6))
    positions = tmp_path / "board.csv"
    positions.write_text("name,x_cm,y_cm\nnose,3,0\ntail,-2.5,0.5\n")
    result = run("halls", "design", "--positions", positions, "-o", table)
    assert result.exit_code == 0, result.output
    halls = read_halls(table)
    assert halls.names == ("nose", "tail")
    np.testing.assert_allclose(halls.position_m, [[0.03, 0], [-0.025, 0.005]])


def test_receiver_by_name_and_from_a_table(tmp_path: Path) -> None:
    deck, table = tmp_path / "deck.toml", tmp_path / "table.toml"
    assert run("receiver", "design", "--board", "deck", "-o", deck).exit_code == 0
    np.testing.assert_allclose(read_receiver(deck).position_m, DECK.position_m)
    positions = tmp_path / "board.csv"
    positions.write_text("x,y,z,nx,ny,nz\n10,0,1,0,0,2\n-10,0,1,0,-3,4\n")
    words = ("--positions", positions, "--units", "mm", "--name", "pod", "-o", table)
    result = run("receiver", "design", *words)
    assert result.exit_code == 0, result.output
    receiver = read_receiver(table)
    assert receiver.name == "pod"
    np.testing.assert_allclose(receiver.position_m, [[0.01, 0, 0.001], [-0.01, 0, 0.001]])
    np.testing.assert_allclose(receiver.normal, [[0, 0, 1], [0, -0.6, 0.8]])


def test_drawing_is_at_true_size_with_forward_up(tmp_path: Path) -> None:
    """The cross of each sensor is where its position says; the SVG has 1 unit a mm, y down."""
    drawing = tmp_path / "h.svg"
    words = ("--circle", 30, "-o", tmp_path / "h.toml", "--drawing", drawing)
    assert run("halls", "design", *words).exit_code == 0
    root = Xml.fromstring(drawing.read_bytes())
    assert root.get("width") == "210mm"
    assert root.get("viewBox") == "0 0 210 297"
    place = {
        text.text: np.array([float(text.get("x", "nan")), float(text.get("y", "nan"))])
        for text in root.iter(f"{SVG}text")
    }
    np.testing.assert_allclose(place["front"] - place["rear"], [0, -60], atol=0.01)
    np.testing.assert_allclose(place["left"] - place["right"], [-60, 0], atol=0.01)


def test_pdf_lists_the_positions(tmp_path: Path) -> None:
    pypdf = pytest.importorskip("pypdf")
    drawing = tmp_path / "a.pdf"
    words = ("--board", "polaris-9", "-o", tmp_path / "a.toml", "--drawing", drawing)
    assert run("array", "design", *words).exit_code == 0
    text = "".join(page.extract_text() for page in pypdf.PdfReader(drawing).pages)
    assert "-80.00" in text
    assert "page 2 of 2" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["array", "design"], "Give one of --board, --grid and --positions"),
        (["array", "design", "--board", "polaris-9", "--grid", "2x2", "--pitch", "5"], "Give one"),
        (["array", "design", "--grid", "2x2"], "--grid and --pitch belong together"),
        (["array", "design", "--board", "polaris-9", "--mlx90393", "default"], "omit --mlx90393"),
        (["array", "design", "--grid", "1x2", "--pitch", "3", "--mlx90393", "x=1"], "as in gain=7"),
        (["halls", "design"], "Give one of --circle and --positions"),
        (["receiver", "design", "--board", "deck", "--pitch", "5"], "belong together"),
    ],
)
def test_wrong_usage(tmp_path: Path, words: list[str], message: str) -> None:
    result = run(*words, "-o", tmp_path / "out.toml")
    assert result.exit_code == 2
    assert message in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("x_mm,y_mm\n1,foo\n", "'foo' instead of a number"),
        ("x,y\n1,2\n", "unit of column 'x' is missing"),
        ("x_m,y_m\n1,2000\n", "y is empty or above 10 m"),
        ("x_mm,y_mm\n1,2\n1,2\n", "two sensors at the position of sensor 0"),
        ("x_mm,y_mm,nx,ny,nz\n1,2,0,0,0\n", "are not a direction"),
        ("x_mm,y_mm,nx,ny,nz\n1,2,0,nan,1\n", "are not a direction"),
        ("x_mm,y_mm,nx\n1,2,1\n", "ny"),
    ],
)
def test_bad_tables(tmp_path: Path, rows: str, message: str) -> None:
    table, output = tmp_path / "board.csv", tmp_path / "out.toml"
    table.write_text(rows)
    result = run("receiver", "design", "--positions", table, "-o", output)
    assert result.exit_code == 1
    assert result.stderr.startswith(f"Error: {table}")
    assert message in result.stderr
    assert not output.exists()


@pytest.mark.slow
def test_nothing_is_written_if_the_drawing_does_not_fit(tmp_path: Path) -> None:
    words = ("--grid", "30x30", "--pitch", 20, "-o", tmp_path / "a.toml")
    result = run("array", "design", *words, "--drawing", tmp_path / "a.pdf")
    assert result.exit_code == 1
    assert "do not fit on paper" in result.stderr
    assert not list(tmp_path.iterdir())
    hinted = result.stderr.split("--size ")[1].split()[0].rstrip(".")
    larger = run("array", "design", *words, "--drawing", tmp_path / "a.pdf", "--size", hinted)
    assert larger.exit_code == 0, larger.output


def test_drawing_is_not_replaced_unasked(tmp_path: Path) -> None:
    drawing = tmp_path / "a.pdf"
    drawing.write_text("mine")
    words = ("--board", "polaris-3", "-o", tmp_path / "a.toml", "--drawing", drawing)
    assert run("array", "design", *words).exit_code == 1
    assert drawing.read_text() == "mine"
    assert not (tmp_path / "a.toml").exists()
    assert run("array", "design", *words, "--overwrite").exit_code == 0
    assert drawing.read_bytes().startswith(b"%PDF")
