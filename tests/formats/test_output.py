"""Output files appear completely or not at all, and replace others only on request."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError
from locatk.formats import output
from locatk.formats.output import PART_SUFFIX, atomic_write, check_output, remove_stale_parts


def names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


def test_file_appears_only_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "out.bin"
    with atomic_write(target) as stream:
        stream.write(b"abc")
        assert not target.exists()
    assert target.read_bytes() == b"abc"
    assert names(tmp_path) == ["out.bin"]


def test_text_is_utf8_with_line_ends_as_given(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "out.csv", mode="w") as stream:
        stream.write("µ\r\nx\n")
    assert (tmp_path / "out.csv").read_bytes() == b"\xc2\xb5\r\nx\n"


def test_permissions_are_those_of_any_new_file(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "ours"):
        pass
    (tmp_path / "usual").write_bytes(b"")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "usual").stat().st_mode


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("overwrite", [False, True])
def test_nothing_is_left_after_an_exception(
    tmp_path: Path, error: type[BaseException], overwrite: bool
) -> None:
    target = tmp_path / "out.bin"
    if overwrite:
        target.write_bytes(b"old")

    def write() -> None:
        with atomic_write(target, overwrite=overwrite) as stream:
            stream.write(b"half")
            raise error

    with pytest.raises(error):
        write()
    assert names(tmp_path) == (["out.bin"] if overwrite else [])
    if overwrite:
        assert target.read_bytes() == b"old"


def test_existing_output_is_refused_before_the_computation(tmp_path: Path) -> None:
    target = tmp_path / "out.bin"
    target.write_bytes(b"old")
    with pytest.raises(OutputExistsError) as caught, atomic_write(target):
        pytest.fail("entered")
    assert "--overwrite" in (caught.value.hint or "")
    with pytest.raises(OutputExistsError):
        check_output(target)
    check_output(target, overwrite=True)
    assert target.read_bytes() == b"old"


@pytest.mark.parametrize("links", [True, False])
def test_a_file_created_in_the_meantime_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    """Another process makes the file while we write, with and without hard links."""
    if not links:

        def no_link(*_: object) -> None:
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(output.os, "link", no_link)
    target = tmp_path / "out.bin"

    def write() -> None:
        with atomic_write(target) as stream:
            stream.write(b"ours")
            target.write_bytes(b"theirs")

    with pytest.raises(OutputExistsError):
        write()
    assert target.read_bytes() == b"theirs"
    assert names(tmp_path) == ["out.bin"]

    with atomic_write(tmp_path / "free") as stream:
        stream.write(b"ours")
    assert (tmp_path / "free").read_bytes() == b"ours"


def test_overwrite_replaces(tmp_path: Path) -> None:
    target = tmp_path / "out.bin"
    target.write_bytes(b"old")
    link = tmp_path / "link"
    link.symlink_to(target)
    with atomic_write(link, overwrite=True) as stream:
        stream.write(b"new")
    assert target.read_bytes() == b"new"
    assert link.is_symlink()


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError) as caught, atomic_write(tmp_path / "no" / "out"):
        pytest.fail("entered")
    assert caught.value.hint


@pytest.mark.parametrize("overwrite", [False, True])
def test_only_regular_files_are_replaced(tmp_path: Path, overwrite: bool) -> None:
    os.mkfifo(tmp_path / "pipe")
    for target in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(OutputExistsError), atomic_write(target, overwrite=overwrite):
            pytest.fail("entered")


def test_system_errors_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(LocatkError) as caught, atomic_write(tmp_path / ("n" * 300)):
        pass
    assert "cannot write" in str(caught.value)
    assert names(tmp_path) == []


def test_full_disk_is_one_line(tmp_path: Path) -> None:
    def write() -> None:
        with atomic_write(tmp_path / "out"):
            raise OSError(28, "No space left on device")

    with pytest.raises(LocatkError, match="No space left"):
        write()
    assert names(tmp_path) == []


def test_errors_about_other_files_pass(tmp_path: Path) -> None:
    def write() -> None:
        with atomic_write(tmp_path / "out"):
            open(tmp_path / "other").close()

    with pytest.raises(FileNotFoundError) as caught:
        write()
    assert not isinstance(caught.value, LocatkError)
    assert names(tmp_path) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="locks of POSIX")
def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "x.bin"
    code = (
        "import os, signal\n"
        "from locatk.formats.output import atomic_write\n"
        f"with atomic_write({str(path)!r}) as stream:\n"
        "    stream.write(b'half'); stream.flush()\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", code])
    [left] = tmp_path.iterdir()
    assert left.name.endswith(PART_SUFFIX)
    with atomic_write(path) as stream:
        stream.write(b"whole")
    assert [each.name for each in tmp_path.iterdir()] == ["x.bin"]
    assert path.read_bytes() == b"whole"


def test_the_output_of_a_running_process_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "x.bin"
    with atomic_write(path, overwrite=True) as first:
        first.write(b"1")
        with atomic_write(path, overwrite=True) as second:
            second.write(b"2")
        assert path.read_bytes() == b"2"
    assert path.read_bytes() == b"1"
    assert [each.name for each in tmp_path.iterdir()] == ["x.bin"]


@pytest.mark.skipif(sys.platform == "win32", reason="open files cannot be moved on Windows")
@pytest.mark.parametrize("overwrite", [True, False])
def test_an_output_is_locked_until_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overwrite: bool
) -> None:
    """Another writer of the same output, or one with as long a name, must not remove it."""
    path = tmp_path / ("x" * 240)
    name = "replace" if overwrite else "link"
    move = getattr(os, name)

    def move_late(source: Path, target: Path) -> None:
        remove_stale_parts(path)
        move(source, target)

    monkeypatch.setattr(output.os, name, move_late)
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(b"whole")
    assert path.read_bytes() == b"whole"
    assert len(list(tmp_path.iterdir())) == 1


def test_an_output_that_was_taken_for_stale_is_created_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = output.lock_file, []

    def lock_late(descriptor: int, *, wait: bool = False) -> bool | None:
        calls.append(wait)
        if len(calls) == 1:  # between creation and lock
            remove_stale_parts(tmp_path / "x.bin")
        return real(descriptor, wait=wait)

    monkeypatch.setattr(output, "lock_file", lock_late)
    with atomic_write(tmp_path / "x.bin") as stream:
        stream.write(b"whole")
    assert calls == [True, False, True]
    assert (tmp_path / "x.bin").read_bytes() == b"whole"
