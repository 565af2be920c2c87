"""CSV files for spreadsheets: no text of a session becomes a formula."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from locatk.core.materials import BillItem, Price
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.bill_of_materials import write_bill
from locatk.formats.exporters.export import plan_files
from locatk.formats.exporters.trajectory_csv import write_csv
from locatk.formats.importers.poses.trajectory_csv import read_csv

FORMULAS = ('=HYPERLINK("http://x","y")', "+1", "-1", "@x", "\t=1", "\r\n=1", "'=1", "plain")

TRACK = Trajectory.from_positions(
    "a", "floor", np.arange(2), np.full((2, 3), -1.5), np.broadcast_to(np.eye(3), (2, 3, 3))
)


def test_names_of_devices_are_no_formulas(tmp_path: Path) -> None:
    tracks = [replace(TRACK, device=name) for name in FORMULAS]
    path = tmp_path / "poses.csv"
    write_csv(path, tracks)
    with open(path, newline="") as stream:
        cells = [cell for row in csv.reader(stream) for cell in row]
    texts = [cell for cell in cells if not cell.lstrip("-").replace(".", "").isdigit()]
    assert not [text for text in texts if text[:1] in tuple("=+-@\t\r\n")]
    assert cells.count("-1.5") == 6 * len(FORMULAS)  # numbers stay numbers
    assert [track.device for track in read_csv(path)] == list(FORMULAS)


def test_items_of_a_bill_are_no_formulas(tmp_path: Path) -> None:
    path = tmp_path / "parts.csv"
    price = Price(1.5, "=EUR", "+2026", "-source")
    write_bill(path, [BillItem("=part", 3, "@detail", price)], overwrite=False)
    row = path.read_text().splitlines()[1]
    assert row == "'=part,3,'@detail,1.5,'=EUR,4.5,'+2026,'-source"


def test_names_of_devices_are_safe_names_of_files(tmp_path: Path) -> None:
    tracks = [replace(TRACK, device=name) for name in ("../x", "-rf", "a\x1b[2J\u202eb")]
    planned = plan_files(tracks, "tum", tmp_path)
    names = ["_._x.tum", "_rf.tum", "a_[2J_b.tum"]
    assert [file.path for file in planned] == [tmp_path / name for name in names]
