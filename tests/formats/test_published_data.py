"""Folder of published recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from locatk.core.errors import MissingDataError
from locatk.formats.published_data import VARIABLE, data_folder


def test_the_order_of_the_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, named, beside = tmp_path / "given", tmp_path / "named", tmp_path / "shared" / "data"
    work = tmp_path / "work"
    for folder in (given, named, beside, work):
        folder.mkdir(parents=True)
    monkeypatch.chdir(work)
    monkeypatch.setenv(VARIABLE, str(named))
    assert data_folder(given) == given
    assert data_folder() == named
    monkeypatch.delenv(VARIABLE)
    assert data_folder() == beside
    # Named and absent is absent: another folder would be a surprise.
    monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
    assert data_folder() is None
    with pytest.raises(MissingDataError):
        data_folder(tmp_path / "none")
