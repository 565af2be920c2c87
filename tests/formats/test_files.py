"""Input files: which are opened, and how much of them is read."""

from __future__ import annotations

import ast
import os
import socket
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

import locatk.formats
from locatk.core.errors import ArtifactError, FormatError, InputError, LocatkError, MissingDataError
from locatk.formats import files
from locatk.formats.artifacts import toml
from locatk.formats.files import open_binary, read_bytes, read_head, read_text
from locatk.formats.importers.dotbot.log import read_dotbot_log
from locatk.formats.tables.delimited import read_table


def test_existing_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("\ufeffgrün\r\n".encode())
    assert read_bytes(path) == path.read_bytes()
    assert read_head(path, 4) == path.read_bytes()[:4]
    assert read_text(path) == "grün\r\n"
    link = tmp_path / "link.txt"
    link.symlink_to(path)
    assert read_bytes(link) == path.read_bytes()


def test_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\n\xff\xfe")
    with pytest.raises(FormatError, match=r"a\.txt:2: not UTF-8 text"):
        read_text(path)
    for missing in (tmp_path / "b.txt", path / "b.txt"):
        with pytest.raises(MissingDataError, match=r"b\.txt: no such file"):
            read_bytes(missing)
    with pytest.raises(InputError, match="a folder instead of a file"):
        read_text(tmp_path)
    with pytest.raises(InputError, match="zero byte"):
        read_bytes("a\0b")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match=r"loop: cannot be read \(Too many levels"):
        read_bytes(tmp_path / "loop")


def _socket(path: Path) -> Path:
    # Paths of sockets have at most 107 bytes.
    with socket.socket(socket.AF_UNIX) as end:
        here = os.getcwd()
        os.chdir(path.parent)
        try:
            end.bind(path.name)
        finally:
            os.chdir(here)
    return path


def _pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def _link_to_device(path: Path) -> Path:
    path.symlink_to("/dev/zero")
    return path


@pytest.mark.parametrize(
    ("make", "kind"),
    [(_socket, "a socket"), (_pipe, "a pipe"), (_link_to_device, "a device")],
)
@pytest.mark.parametrize("read", [read_bytes, read_text, lambda path: read_head(path, 4)])
def test_only_regular_files_are_opened(
    tmp_path: Path, make: Callable[[Path], Path], kind: str, read: Callable[[Path], object]
) -> None:
    path = make(tmp_path / "special")
    with pytest.raises(FormatError, match="special: not a regular file") as caught:
        read(path)
    assert kind in (caught.value.hint or "")


def test_large_files_are_refused_before_memory_is_allocated(tmp_path: Path) -> None:
    path = tmp_path / "large.toml"
    with open(path, "wb") as stream:
        stream.truncate(1 << 42)
    with pytest.raises(FormatError, match=r"4,398,046,511,104 bytes, more than the limit of 5"):
        read_bytes(path)
    with pytest.raises(FormatError, match=r"limit of 33,554,432"):
        read_text(path)
    assert read_head(path, 3) == b"\0\0\0"
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345"
    tracemalloc.start()
    read_bytes(path)
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()
    with pytest.raises(FormatError, match="5 bytes, more than the limit of 4"):
        read_bytes(path, 4)


def test_a_file_of_unknown_size_is_read_to_the_limit() -> None:
    path = Path("/proc/self/maps")  # a regular file that claims to be empty
    if not path.exists():
        pytest.skip("no /proc")
    assert len(read_bytes(path)) > 100
    with pytest.raises(FormatError, match="limit of 100"):
        read_bytes(path, 100)


def test_errors_in_the_block_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"1")
    with pytest.raises(InputError, match=r"a\.bin: cannot be read \(Bad\)"), open_binary(path):
        raise OSError(5, "Bad")
    with pytest.raises(LocatkError, match="own"), open_binary(path):
        raise LocatkError("own")


MODULES_WITH_OTHER_FILES = {
    "benchmarks": "files that the benchmark itself has written",
    "schemas": "generated code",
    "output.py": "files that are written",
    "artifacts/map_library.py": "files of the package",
    "capture/recording_files.py": "the recording that is written",
    "capture/port_listing.py": "files of /proc and /sys",
    "emulation/pseudo_terminal.py": "a terminal",
    "sinks/jsonl.py": "the file that is written",
    "sessions/recovery/recover.py": "the output, which is read back",
}


@pytest.mark.slow
def test_all_readers_open_files_here() -> None:
    folder = Path(locatk.formats.__path__[0])
    found = []
    for path in sorted(folder.rglob("*.py")):
        name = path.relative_to(folder).as_posix()
        if name == "files.py" or name in MODULES_WITH_OTHER_FILES:
            continue
        if name.partition("/")[0] in MODULES_WITH_OTHER_FILES:
            continue
        found += [
            f"{name}:{node.lineno}: {ast.unparse(node)}"
            for node in ast.walk(ast.parse(path.read_text("utf-8")))
            if isinstance(node, ast.Call) and _opens_path(node)
        ]
    assert not found


def _opens_path(call: ast.Call) -> bool:
    """Return whether a call opens a path without :mod:`locatk.formats.files`."""
    if isinstance(call.func, ast.Name):
        return call.func.id == "open"
    if not isinstance(call.func, ast.Attribute):
        return False
    owner, method = ast.unparse(call.func.value).lower(), call.func.attr
    if method in ("read_bytes", "read_text"):
        return owner.endswith(("path", "file", "document")) or owner.startswith("path(")
    return method in ("fromfile", "imread") or (
        method == "open" and owner.endswith(("path", "file"))
    )


def test_the_check_of_readers_finds_openings() -> None:
    for text in ("open(p)", "path.open('rb')", "self.path.read_bytes()", "Path(x).read_text()"):
        call = ast.parse(text, mode="eval").body
        assert isinstance(call, ast.Call)
        assert _opens_path(call), text
    assert files.MAX_TEXT_BYTES < files.MAX_FILE_BYTES


def test_a_key_of_many_parts_is_refused_at_once() -> None:
    for key in ("a" + ".a" * 100_000, "a" + ' . "b"' * 20, "[" + "a." * 20 + "a]\n a"):
        with pytest.raises(ArtifactError, match="a key of more than 16 parts"):
            toml.loads(f"{key} = 1\n", "x.toml")
    assert toml.loads(f"a = [{'1.5, ' * 2000}]\n", "x.toml")["a"][0] == 1.5
    dots = "." * 100
    assert toml.loads(f"a = '{dots}' # {dots}\n'{dots}' = 1", "x.toml") == {"a": dots, dots: 1}


def test_tables_of_many_columns_are_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "wide.csv"
    path.write_text("1," * 1_000_000)
    with pytest.raises(FormatError, match="1000001 columns, more than 1000"):
        read_table(path)


def test_large_logs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "large.log"
    with open(path, "wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(FormatError, match="larger than 8 GiB"):
        read_dotbot_log([path])
