"""Export of poses as Parquet, read with pyarrow."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.errors import LocatkError, OutputExistsError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.trajectory import Trajectory, has_orientation
from locatk.formats.exporters.parquet import AXES, COVARIANCE, write_parquet
from locatk.formats.exporters.trajectory_csv import write_csv
from locatk.formats.importers.poses.trajectory_csv import COLUMNS, read_csv
from locatk.formats.tables.timestamps import format_epoch_seconds

START_NS = 1_700_000_000_123_456_789


def track(device: str, frame: str = "floor", n: int = 30, seed: int = 1) -> Trajectory:
    """A path with correlations, in whose odd rows nothing but x and y is known."""
    random = np.random.default_rng(seed)
    factor = random.normal(size=(n, 6, 6)) * 1e-3
    covariance = factor @ factor.transpose(0, 2, 1)
    covariance[1::2, 2:, :] = covariance[1::2, :, 2:] = np.nan
    return Trajectory(
        device,
        frame,
        START_NS + np.cumsum(random.integers(1, 10**8, n)),
        random.normal(size=(n, 3)),
        quaternion_from_heading(random.normal(size=n)),
        covariance,
    )


@pytest.fixture
def parquet():  # type: ignore[no-untyped-def]
    return pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")


def test_all_values_are_written(parquet, tmp_path: Path) -> None:
    path, tracks = tmp_path / "poses.parquet", [track("red"), track("lab/blue", "map", seed=2)]
    write_parquet(path, tracks)
    table = parquet.read_table(path)
    assert table.num_rows == 60
    for each in tracks:
        rows = np.flatnonzero(table["device"].to_numpy(zero_copy_only=False) == each.device)
        mine = table.take(rows)
        assert mine["time_ns"].to_pylist() == each.time_ns.tolist()
        assert set(mine["frame"].to_pylist()) == {each.frame}
        pose = np.column_stack([mine[name].to_numpy() for name in COLUMNS[2:9]])
        quaternion = np.where(has_orientation(each)[:, None], each.quaternion, np.nan)
        assert np.array_equal(pose, np.hstack([each.position, quaternion]), equal_nan=True)
        full = np.full((30, 6, 6), np.nan)
        for name in COVARIANCE:
            i, j = (AXES.index(axis) for axis in name.split("_")[1:3])
            full[:, i, j] = full[:, j, i] = mine[name].to_numpy()
        assert np.array_equal(full, each.covariance, equal_nan=True)


def test_columns_are_those_of_csv_and_more(parquet, tmp_path: Path) -> None:
    """The same values in the same rows; the rest follows, and every name bears its unit."""
    tracks = [track("red"), track("blue", seed=2)]
    write_parquet(tmp_path / "poses.parquet", tracks)
    table = parquet.read_table(tmp_path / "poses.parquet")
    # The columns of earlier versions keep their order: the probability is the last one.
    assert tuple(table.column_names[:13]) == COLUMNS[:13]
    assert table.column_names[13:16] == ["time_ns", "frame", "cov_x_x_m2"]
    assert table.column_names[-1] == COLUMNS[-1] == "probability"
    assert COVARIANCE[5] == "cov_x_rz_m_rad"
    assert COVARIANCE[-1] == "cov_rz_rz_rad2"
    assert len(COVARIANCE) == len(set(COVARIANCE)) == 21
    write_csv(tmp_path / "poses.csv", tracks)
    for back in read_csv(tmp_path / "poses.csv"):
        rows = table.filter(np.array(table["device"].to_pylist()) == back.device)
        sigma = rows["sigma_heading_rad"].to_numpy()
        assert np.array_equal(sigma, back.sigma[:, 5], equal_nan=True)
        text = [float(format_epoch_seconds(time_ns)) for time_ns in back.time_ns.tolist()]
        assert rows["time_s"].to_pylist() == text


def test_unknown_values_are_null(parquet, tmp_path: Path) -> None:
    write_parquet(tmp_path / "poses.parquet", [track("red")])
    table = parquet.read_table(tmp_path / "poses.parquet")
    assert table["sigma_x_m"].null_count == 0
    assert table["sigma_heading_rad"].null_count == 15
    assert table["cov_x_rz_m_rad"].null_count == 15
    assert table["probability"].null_count == 30
    assert not np.isnan([x for x in table["cov_x_rz_m_rad"].to_pylist() if x is not None]).any()


def test_probabilities_are_the_last_column(parquet, tmp_path: Path) -> None:
    probability = np.linspace(0.9, 1.0, 30)
    probability[3] = np.nan
    path = tmp_path / "poses.parquet"
    write_parquet(path, [replace(track("red"), probability=probability), track("blue")])
    column = parquet.read_table(path)["probability"]
    assert column.null_count == 31
    np.testing.assert_array_equal(column.to_numpy()[:30], probability)


def test_the_schema_contains_the_origin(parquet, tmp_path: Path) -> None:
    path = tmp_path / "poses.parquet"
    facts = {"system": "dots", "method": "lattice", "source": "Fahrt 1 \u00fc.mcap"}
    write_parquet(path, [track("red")], facts=facts)
    metadata = {
        key.decode(): value.decode() for key, value in parquet.read_metadata(path).metadata.items()
    }
    for key, value in facts.items():
        assert metadata[f"locatk.{key}"] == value
    assert metadata["locatk.exported_by"].startswith("locatk ")


def test_no_poses_are_a_table_without_rows(parquet, tmp_path: Path) -> None:
    write_parquet(tmp_path / "none.parquet", [])
    write_parquet(tmp_path / "some.parquet", [track("red")])
    nothing, some = (parquet.read_schema(tmp_path / f"{name}.parquet") for name in ("none", "some"))
    assert nothing.equals(some)
    assert parquet.read_table(tmp_path / "none.parquet").num_rows == 0


def test_equal_input_gives_equal_bytes_and_existing_files_are_kept(parquet, tmp_path: Path) -> None:
    path = tmp_path / "poses.parquet"
    write_parquet(path, [track("red")])
    before = path.read_bytes()
    with pytest.raises(OutputExistsError):
        write_parquet(path, [track("blue")])
    assert path.read_bytes() == before
    write_parquet(path, [track("red")], overwrite=True)
    assert path.read_bytes() == before


def test_the_error_without_pyarrow_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(LocatkError, match="needs pyarrow") as caught:
        write_parquet(tmp_path / "poses.parquet", [track("red")])
    assert caught.value.hint == 'Install it: pip install "locatk[parquet]"'
    assert not any(tmp_path.iterdir())
