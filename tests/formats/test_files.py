"""Input files that are read completely."""

from __future__ import annotations

from pathlib import Path

import pytest

from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.formats.files import read_bytes, read_text


def test_existing_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("\ufeffgrün\r\n".encode())
    assert read_bytes(path) == path.read_bytes()
    assert read_bytes(path, 4) == path.read_bytes()[:4]
    assert read_text(path) == "\ufeffgrün\r\n"


def test_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(FormatError, match=r"a\.txt: not UTF-8 text"):
        read_text(path)
    for missing in (tmp_path / "b.txt", path / "b.txt"):
        with pytest.raises(MissingDataError, match=r"b\.txt: no such file"):
            read_bytes(missing)
    with pytest.raises(InputError, match="cannot be read"):
        read_text(tmp_path)
