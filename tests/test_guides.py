"""Every command that README and docs show is run, in order, as a reader would.

The ```sh blocks of a page are run in one folder, page by page. Plain ``locatk`` lines run in
this process, which saves a second each, also with ``> file`` or in a ``for`` loop; lines with
pipes, globs and the like, and those of other programs, by bash with a ``locatk`` on the PATH.
Each must end with status 0.

What a reader has and a test machine has not:

- A serial port ``/dev/tty...`` is a pseudo-terminal, on which an emulator is the device of the
  line's ``--device``; ``camera:0`` is a video of the sheet of the line's ``--artifact``.
- A recording, and ``locatk live`` of a port, take at most :data:`MAX_RECORDING_S`, and without
  ``--duration`` :data:`RECORDING_S`, as if they were ended by Ctrl-C.
- ``locatk emulate``, ``dask scheduler`` and ``dask worker`` are other terminals, which run to the
  page's end.
- ``s3://`` is a server of moto on this machine; a bucket holds the sessions that are in the
  page's folder when it is first named.
- Files that do not come out of the page's own commands are in :data:`FILES`. Where published
  data, an optional package or a program of :data:`OPTIONAL_PROGRAMS` is absent, the page is
  skipped from there on.

Comments that readers do not see, on the lines before a block, tell what is not the rule::

    <!-- status 3 -->                    of the ```sh block: one of its commands ends with 3
    <!-- guide: file all.csv -->         the block (of any language) is that file
    <!-- guide: file b.toml after a.toml -->   the same, with a.toml before it

What no machine can run is a ```console block (its usage is checked in test_readme.py), or stands
in :data:`EXCEPTIONS`.
"""

from __future__ import annotations

import fnmatch
import functools
import itertools
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from click.testing import CliRunner

from locatk.cli.app import app

ROOT = Path(__file__).resolve().parent.parent

EXCEPTIONS = {
    "python3 -m venv": "`Run it` and `Test it` of the README: .ci/run runs them",
    "locatk bench": "minutes; tests/formats/test_bench*.py run them with less",
}
"""How a command begins that is not run, and why."""

OPTIONAL_PROGRAMS = {"gs": "Ghostscript"}
"""Other programs that a page runs and a machine may lack; the page is skipped from there on."""

CORE_PAGES = ("README.md", "docs/first-hour-")
"""How the pages begin whose commands need no extra."""

DEVICES = {"polaris-array": "polaris", "dotbot-gateway": "lighthouse", "locatk": "landmarks"}
"""``--device`` to the system that is simulated for it."""

LIMIT_S = 120.0

RECORDING_S = 1.0
"""Length of a recording without ``--duration``."""

MAX_RECORDING_S = 3.5
"""Longest recording: one pass of the simulated robots, which the pages let pass several times."""

SHELL = re.compile(r"[|&;<>$`*?~!]|(?<![\w{])\{")
"""In a line that only a shell understands."""

QUOTED = re.compile(r"""'[^']*'|"[^"$`]*"|\s#.*""")
"""In a line, but not for the shell."""

LOOP = re.compile(r"for (\w+) in ([\w ]+); do ([^;]+); done")
REDIRECTION = re.compile(r"\s>\s(\S+)$")


# ---- pages


@dataclass(frozen=True)
class Block:
    """A fenced block: its first line in the page, language, text and hints to this test."""

    line: int
    language: str
    text: str
    hints: tuple[tuple[str, str], ...]

    def hint(self, name: str) -> str | None:
        return dict(self.hints).get(name)

    def commands(self) -> list[str]:
        """Commands, which may go on over several lines: after a backslash, or in quotes."""
        found, begun = [], ""
        for line in self.text.replace("\\\n", " ").splitlines(keepends=True):
            begun += line
            try:
                words = shlex.split(begun, comments=True)
            except ValueError:  # an open quotation
                continue
            found += [begun.strip()] if words else []
            begun = ""
        assert not begun, begun
        return found


HINT = re.compile(r"<!--\s*(?:guide:\s*)?(status|file)\s+(.*?)\s*-->")


def blocks(text: str) -> list[Block]:
    """All fenced blocks of a page."""
    found = []
    hints: list[tuple[str, str]] = []
    fence: tuple[int, str, str] | None = None
    body: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        if fence is None:
            if opened := re.match(r"( *```+)(\w*)", line):
                fence, body = (number, opened[1], opened[2]), []
            elif hint := HINT.search(line):
                hints.append((hint[1], hint[2]))
            elif line.strip():
                hints = []
        elif line.rstrip() == fence[1]:
            found.append(Block(fence[0], fence[2], "\n".join(body) + "\n", tuple(hints)))
            fence, hints = None, []
        else:
            body.append(line)
    assert fence is None, f"the block of line {fence and fence[0]} has no end"
    return found


def pages() -> list[str]:
    """README and docs that show commands."""
    every = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [
        path.relative_to(ROOT).as_posix()
        for path in every
        if any(block.language == "sh" for block in blocks(path.read_text(encoding="utf-8")))
    ]


# ---- what a reader has


def _toml_of_formats(name: str) -> str:
    """The example of an artifact in docs/formats.md, by its heading."""
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    section = re.search(rf"^## {re.escape(name)}\n(.*?)(?=^## )", text, re.M | re.S)
    assert section, name
    return next(block.text for block in blocks(section[1]) if block.language == "toml")


def _pictures(sheet: Path, frames: int = 20) -> Iterator[bytes]:
    """PNG files of a camera over a printed sheet."""
    from locatk.core.dots.simulation.session import SimulationOptions, simulate
    from locatk.formats.artifacts.sheets import read_manifest
    from locatk.formats.images import encode_png

    made = simulate(read_manifest(sheet), SimulationOptions(frames=frames))
    yield from map(encode_png, made.frames.images)


def _frames(folder: Path, words: list[str]) -> None:
    (folder / "frames").mkdir()
    for number, png in enumerate(_pictures(folder / words[words.index("--sheet") + 1])):
        (folder / "frames" / f"{number:04d}.png").write_bytes(png)


def _video(folder: Path, words: list[str]) -> str:
    """A video in the place of a camera."""
    import cv2
    import numpy as np

    path = folder / "camera.avi"
    writer = None
    for png in _pictures(folder / words[words.index("--artifact") + 1]):
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        if writer is None:
            size = image.shape[1], image.shape[0]
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20, size)
        writer.write(image)
    assert writer is not None
    writer.release()
    return f"camera:{path.name}"


def _drive_csv(folder: Path, words: list[str]) -> None:
    """A table of hall sensors and odometry over the map of the line."""
    import numpy as np

    from locatk.core.geometry import heading_from_quaternion
    from locatk.core.landmarks.simulation.session import SimulationOptions, simulate
    from locatk.formats.artifacts.maps import read_map

    made = simulate(read_map(folder / words[words.index("--map") + 1]), SimulationOptions())
    (samples,), (odometry,) = made.samples, made.odometry
    times = (samples.time_ns - samples.time_ns[0]) * 1e-9
    known = (odometry.time_ns - samples.time_ns[0]) * 1e-9
    heading = np.unwrap(heading_from_quaternion(odometry.quaternion))
    way = [1e3 * odometry.position[:, 0], 1e3 * odometry.position[:, 1], np.degrees(heading)]
    columns = [times, *(np.interp(times, known, each) for each in way), *(1e3 * samples.field_t.T)]
    header = "t_s,x_mm,y_mm,heading_deg,front,left,rear,right"
    table = np.column_stack(columns)
    np.savetxt(folder / "drive.csv", table, "%.4f", ",", header=header, comments="")


def _crazyflie_log(folder: Path, words: list[str]) -> None:
    """A log of a Crazyflie that rested on four points of the floor."""
    tools = runpy.run_path(str(ROOT / "tests" / "data" / "crazyflie_visit.py"))
    tools["write_log"](folder / "log00")


def _published(place: str) -> Callable[[Path, list[str]], None]:
    """A link to published data."""

    def provide(folder: Path, words: list[str]) -> None:
        from locatk.formats.published_data import data_folder

        data = data_folder()
        if data is None or not (data / place).exists():
            pytest.skip(f"the published {place} is not there (see LOCATK_DATA)")
        (folder / Path(place).name).symlink_to((data / place).resolve())

    return provide


FILES: Mapping[str, Callable[[Path, list[str]], None]] = {
    "frames": _frames,
    "drive.csv": _drive_csv,
    "log00": _crazyflie_log,
    "map.toml": lambda folder, _: _made(folder, "map", "design", "4x4", "-o", "map.toml"),
    "tag.toml": lambda folder, _: _made(folder, "tag", "design", "-o", "tag.toml"),
    "halls.toml": lambda folder, _: _write(folder / "halls.toml", _toml_of_formats("halls.toml")),
    "twoLH-3D_scene": _published("lighthouse/twoLH-3D_scene"),
    "twoLH-2D_scene": _published("lighthouse/twoLH-2D_scene"),
    "oneLH-2D_scene": _published("lighthouse/oneLH-2D_scene"),
    "logic_analyser_capture.sal": _published(
        "lighthouse/benchmarks/demodulation_code/logic_analyser_capture.sal"
    ),
    **{f"RawData_{k}.csv": _published(f"polaris/default/RawData_{k}.csv") for k in range(1, 11)},
}
"""What a reader has beside what the page makes: name to what puts it into the folder."""


def _made(folder: Path, *words: str) -> None:
    """What another page makes."""
    result = CliRunner().invoke(app, words, prog_name="locatk")
    assert result.exit_code == 0, result.output


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


# ---- running


class Reader:
    """Somebody who types what a page shows, in one folder."""

    def __init__(self, folder: Path, links: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder / "here"
        self.folder.mkdir()
        self.links = links
        self.monkeypatch = monkeypatch
        self.buckets: set[str] = set()
        # The environment of locatk is active: its commands and its Python come first.
        shims = folder / "bin"
        shims.mkdir()
        for name, module in (("locatk", " -m locatk.cli"), ("python", "")):
            _write(shims / name, f'#!/bin/sh\nexec "{sys.executable}"{module} "$@"\n')
            (shims / name).chmod(0o755)
        monkeypatch.setenv("PATH", f"{shims}{os.pathsep}{os.environ['PATH']}")
        monkeypatch.chdir(self.folder)

    def file(self, name: str, text: str) -> None:
        """What the hint ``file`` says."""
        name, _, before = name.partition(" after ")
        first = (self.folder / before).read_text(encoding="utf-8") + "\n" if before else ""
        _write(self.folder / name, first + text)

    def type(self, line: str) -> int:
        """Run a line; its exit status.

        Raises
        ------
        AssertionError
            The status is neither 0 nor 3, with what the command said.
        """
        if loop := LOOP.fullmatch(line):
            name, values, body = loop.groups()
            return max(self.type(body.replace(f"${name}", v)) for v in values.split())
        words = shlex.split(line, comments=True)
        self.provide(words)
        if words[0] == "cd":
            self.folder /= words[1]
            self.monkeypatch.chdir(self.folder)
            return 0
        if words[:2] == ["locatk", "emulate"]:
            self.links.enter_context(emulated(words[2:], self.folder))
            return 0
        if words[0] == "dask":
            pytest.importorskip("distributed", reason=f"{line} needs locatk[dask]")
            self.links.enter_context(terminal([sys.executable, "-m", *words], self.folder))
            return 0
        if words[0] in OPTIONAL_PROGRAMS and shutil.which(words[0]) is None:
            pytest.skip(f"{line} needs {OPTIONAL_PROGRAMS[words[0]]}")
        for bucket in re.findall(r"s3://([\w-]+)", line):
            self.store(bucket)
        with ExitStack() as stack:
            for index, word in enumerate(words):
                if word.startswith("/dev/tty"):
                    words[index] = Path(word).name
                    name = words[words.index("--device") + 1]
                    stack.enter_context(plugged_in(name, self.folder / words[index]))
                elif word == "camera:0":
                    words[index] = _video(self.folder, words)
            plain = QUOTED.sub("", line)
            redirected = REDIRECTION.search(plain)
            if words[0] == "locatk" and not SHELL.search(REDIRECTION.sub("", plain)):
                words = words[1:-2] if redirected else words[1:]
                result = CliRunner().invoke(app, shortened(words), prog_name="locatk")
                status, said = result.exit_code, result.output
                if redirected:
                    _write(self.folder / redirected[1], result.stdout)
            else:
                done = subprocess.run(
                    ["bash", "-euo", "pipefail", "-c", line],
                    cwd=self.folder,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                    timeout=LIMIT_S,
                )
                status, said = done.returncode, done.stdout
        if status and (missing := re.search(r'pip install "locatk\[\w+\]"', said)):
            pytest.skip(f"{line} needs {missing[0]}")
        assert status in (0, 3), f"{line}\nended with {status}:\n{said}"
        return status

    def provide(self, words: list[str]) -> None:
        """Put into the folder what a reader has."""
        for before, word in itertools.pairwise(["", *words]):
            if before in ("-o", "--output") or word in ("", ".") or word.startswith(("/", "-")):
                continue
            pattern = re.sub(r"\$\{?\w+\}?", "*", Path(word).parts[0])
            for name in fnmatch.filter(FILES, pattern) if pattern != "*" else ():
                if not (self.folder / name).exists():
                    FILES[name](self.folder, words)

    def store(self, bucket: str) -> None:
        """A bucket with the sessions of the folder, where the page names it first."""
        from locatk.formats.pipeline.session_search import read_facts

        if bucket in self.buckets:
            return
        moto = pytest.importorskip("moto.server", reason="s3:// needs moto[server]")
        fsspec = pytest.importorskip("s3fs", reason="s3:// needs locatk[s3]")
        if not self.buckets:
            server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
            server.start()
            self.links.callback(server.stop)
            host, port = server.get_host_and_port()
            for name, value in {
                "AWS_ENDPOINT_URL": f"http://{host}:{port}",
                "AWS_ACCESS_KEY_ID": "reader",
                "AWS_SECRET_ACCESS_KEY": "secret",
                "AWS_DEFAULT_REGION": "us-east-1",
            }.items():
                self.monkeypatch.setenv(name, value)
        self.buckets.add(bucket)
        store = fsspec.S3FileSystem(skip_instance_cache=True)
        store.mkdir(bucket)
        for path in self.folder.rglob("*.mcap"):
            if read_facts(str(path)).get("kind") == "solution":
                continue
            store.put_file(str(path), f"{bucket}/{path.relative_to(self.folder).as_posix()}")


def shortened(words: list[str]) -> list[str]:
    """The words of a command, where those of a recording end it soon.

    Servers get any port that is free, because pages run side by side.
    """
    if words[0] == "live":
        words = [re.sub(r"^(web|foxglove)://:\d+$", r"\1://:0", word) for word in words]
    is_endless = words[0] == "capture" and "--list" not in words
    is_endless |= words[0] == "live" and not any(word.startswith("replay:") for word in words)
    if not is_endless:
        return words
    if "--duration" not in words:
        return [*words, "--duration", f"{RECORDING_S}s"]
    after = words.index("--duration") + 1
    duration_s = min(float(words[after].removesuffix("s")), MAX_RECORDING_S)
    return [*words[:after], f"{duration_s}s", *words[after + 1 :]]


@functools.cache
def simulated(device: str, folder: TemporaryDirectory[str]) -> Path:
    """A simulated session of a device, made once."""
    from locatk.formats.emulation.sources import write_simulated_session

    path = Path(folder.name, f"{device}.mcap")
    write_simulated_session(DEVICES[device], path)
    return path


@functools.cache
def shared_folder() -> TemporaryDirectory[str]:
    """A folder for all pages, which is removed at the end of this process."""
    return TemporaryDirectory(prefix="locatk-guides-")


@contextmanager
def plugged_in(device: str, link: Path) -> Iterator[None]:
    """A device that sends a simulated session endlessly, on a port of this process."""
    from locatk.formats.emulation.byte_stream import RecordedPace, repeat_packets
    from locatk.formats.emulation.emulator import Emulator
    from locatk.formats.emulation.pseudo_terminal import PseudoPort
    from locatk.formats.emulation.sources import select_source
    from locatk.formats.sessions.reader import Session

    source = Session.open(simulated(device, shared_folder()))
    packets = select_source(source, device).packets
    emulator = Emulator(PseudoPort(link), RecordedPace(repeat_packets(packets, 0), 1.0))
    thread = threading.Thread(target=emulator.run)
    thread.start()
    try:
        yield
    finally:
        emulator.stop()
        thread.join(LIMIT_S)


@contextmanager
def ending(process: subprocess.Popen[str]) -> Iterator[None]:
    """Whatever happens, the process ends."""
    try:
        yield
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if process.stdout is not None:
            process.stdout.close()


@contextmanager
def terminal(words: list[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another terminal, in which a program runs while the block does."""
    process = subprocess.Popen(
        words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    with ending(process):
        yield process


@contextmanager
def emulated(words: list[str], folder: Path) -> Iterator[None]:
    """``locatk emulate words...``, from when its port is there to the end."""
    port = folder / words[words.index("--link") + 1]
    with terminal(["locatk", "emulate", *words], folder) as process:
        wait_for(port.exists, process)
        yield


def wait_for(come: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    """Until it has come; the process that shall bring it must not fail before."""
    give_up = time.monotonic() + LIMIT_S
    while not come() and process.poll() is None:
        assert time.monotonic() < give_up, process.args
        time.sleep(0.02)
    if process.poll() not in (None, 0):
        raise AssertionError(f"{process.args!r} failed:\n{process.communicate()[0]}")


def read_page(page: str, text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Type all that a page shows.

    Raises
    ------
    AssertionError
        A command fails, or a block does not end with the status that it says.
    """
    with ExitStack() as links:
        reader = Reader(folder, links, monkeypatch)
        for block in blocks(text):
            if name := block.hint("file"):
                reader.file(name, block.text)
            if block.language != "sh":
                continue
            statuses = [
                reader.type(line)
                for line in block.commands()
                if not line.startswith(tuple(EXCEPTIONS))
            ]
            wanted = int(block.hint("status") or 0)
            assert max(statuses, default=0) == wanted, f"{page}:{block.line}: {statuses}"


needs_terminals = pytest.mark.skipif(
    shutil.which("bash") is None or not hasattr(os, "openpty"), reason="no bash or no terminals"
)


@pytest.mark.slow
@needs_terminals
@pytest.mark.parametrize("page", pages())
def test_commands_of_a_page_run(
    page: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    without_extras: Callable[..., None],
) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    if not page.startswith(CORE_PAGES):
        read_page(page, text, tmp_path, monkeypatch)
        return
    without_extras()
    try:
        read_page(page, text, tmp_path, monkeypatch)
    except pytest.skip.Exception as skipped:
        if "locatk[" in str(skipped):
            pytest.fail(str(skipped))
        raise


def test_commands_are_where_they_are_found() -> None:
    """A block of another name would not be run."""
    every = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    languages = {
        block.language for path in every for block in blocks(path.read_text(encoding="utf-8"))
    }
    assert languages <= {"", "sh", "text", "console", "python", "toml", "json", "csv", "yaml"}


def test_exceptions_are_needed() -> None:
    text = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in pages())
    lines = [line for block in blocks(text) if block.language == "sh" for line in block.commands()]
    assert all(any(line.startswith(one) for line in lines) for one in EXCEPTIONS)


PAGE = """
```text
locatk nothing
```

<!-- guide: file b.txt -->
```
two
```

```sh
# a comment
echo one > a.txt       # it's here
cat a.txt \\
    b.txt | grep -c o > count.txt
printf '%s\n' 'three
four' > c.txt
locatk --version && test -s c.txt
for k in 1 2; do locatk --version > version$k.txt; done
```

<!-- status 3 -->
```sh
bash -c 'exit 3'
```
"""


@needs_terminals
def test_a_page_is_read_as_by_its_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_page("page", PAGE, tmp_path, monkeypatch)
    folder = Path.cwd()
    assert (folder / "count.txt").read_text() == "2\n"
    assert (folder / "c.txt").read_text() == "three\nfour\n"
    assert (folder / "version2.txt").read_text().startswith("locatk ")


@pytest.mark.slow
@needs_terminals
@pytest.mark.parametrize(
    ("block", "said"),
    [
        ("```sh\nlocatk info nothing.mcap\n```", "ended with 1"),
        ("```sh\nlocatk info nothing.mcap > said.txt\n```", "ended with 1"),
        ("```sh\nfalse | cat\n```", "ended with 1"),
        ("```sh\nbash -c 'exit 3'\n```", "page:1: .3."),
        ("```sh\nfor k in 3 0; do bash -c 'exit '$k; done\n```", "page:1: .3."),
        ("<!-- status 3 -->\n```sh\ntrue\n```", "page:2: .0."),
        ("<!-- status 3 -->\n\nwords\n\n```sh\nbash -c 'exit 3'\n```", "page:5: .3."),
        ("```sh\nlocatk capture port --device lines -o run.mcap\n```", "ended with 1|failed"),
        ("```sh\nlocatk emulate nothing.mcap --link port\n```", "failed"),
    ],
)
def test_what_fails_on_a_page_is_told(
    block: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(AssertionError, match=said):
        read_page("page", block, tmp_path, monkeypatch)
