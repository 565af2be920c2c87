"""Many recordings: whatever they are, wherever they lie, whoever solves them."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from locatk.formats.pipeline import SolvedSession, SolveFailure, SolveReport, SolveRequest, solving
from locatk.formats.pipeline.provenance import source_facts
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_solution

Run = Callable[..., Result]

SONAR = '''
"""A solver of somebody else: answers with the truth, and does what the session's name says."""

import os, signal, time
from pathlib import Path

from locatk.core.errors import DegenerateError
from locatk.core.solution import Solution
from locatk.formats.pipeline import SolvedSession
from locatk.formats.sessions.observations import read_truth

class Deadly(tuple):
    def __iter__(self):
        os.kill(os.getpid(), signal.SIGKILL)

class Slow(tuple):
    def __iter__(self):
        started, go = Path(os.environ["SONAR"]) / "slow", Path(os.environ["SONAR"]) / "go"
        if not started.exists():
            started.with_name("new").write_text(str(os.getpid()))
            started.with_name("new").rename(started)
        until = time.monotonic() + 60
        while not go.exists():
            assert time.monotonic() < until
            time.sleep(0.02)
        return super().__iter__()

def solve(session, request):
    name = Path(session.path).stem
    with open(Path(os.environ["SONAR"]) / "calls", "a") as stream:
        stream.write(f"{name}\\n")
    if name == "still":
        raise DegenerateError("one robot standing still", hint="Drive it around")
    if name == "broken":
        raise ZeroDivisionError("by nought")
    # Warnings are walked through while the solution is written: the file is half there.
    warnings = {"deadly": Deadly, "slow": Slow}.get(name, tuple)()
    solution = Solution("sonar", "echo", tuple(read_truth(session)), warnings=warnings)
    return SolvedSession(solution, 0.5)
'''


@pytest.fixture
def sonar(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The plug-in `sonar`, for this process and those that it starts; the folder it writes to."""
    plugin, folder = tmp_path / "plugin", tmp_path / "sonar"
    (plugin / "sonar-1.dist-info").mkdir(parents=True)
    folder.mkdir()
    (plugin / "locatk_test_sonar.py").write_text(SONAR)
    about = plugin / "sonar-1.dist-info"
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: sonar\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[locatk.systems]\nsonar = locatk_test_sonar:solve\n")
    paths = [str(plugin), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    monkeypatch.syspath_prepend(plugin)
    monkeypatch.setenv("SONAR", str(folder))
    monkeypatch.delitem(sys.modules, "locatk_test_sonar", raising=False)
    return folder


@pytest.fixture
def day(tmp_path: Path, record: Callable[..., Path], sonar: Path) -> Callable[..., list[Path]]:
    """``day("a", "b")`` records these sessions in the folder `day`."""
    folder = tmp_path / "day"
    folder.mkdir()

    def make(*names: str) -> list[Path]:
        return [
            record(folder / f"{name}.mcap", ("red", *(f"robot{n}" for n in range(number))), "sonar")
            for number, name in enumerate(names)
        ]

    return make


def entries(text: str) -> list[dict[str, Any]]:
    """The sessions of `--json`, one a line."""
    return [entry for line in text.splitlines() for entry in json.loads(line)["sessions"]]


def contents(folder: Path) -> dict[str, bytes]:
    """Every file in a folder, hidden ones too."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def calls(sonar: Path) -> list[str]:
    path = sonar / "calls"
    return path.read_text().split() if path.exists() else []


def command(*args: object) -> list[str]:
    return [sys.executable, "-m", "locatk.cli", *map(str, args)]


def wait_for(what: Callable[[], object], *, seconds: float = 40) -> None:
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until, "it does not come"
        time.sleep(0.02)


def temporary(folder: Path) -> list[Path]:
    """What a batch left in the folder for temporary files."""
    return sorted(folder.glob("locatk-*"))


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("is_pipe", [True, False], ids=["pipe without reader", "full disk"])
def test_a_batch_is_solved_without_a_reader_of_its_results(
    day: Callable[..., list[Path]], tmp_path: Path, is_pipe: bool
) -> None:
    sessions = day("a", "b", "c")
    with open("/dev/full", "wb") as full:
        process = subprocess.Popen(
            command("solve", *sessions, "-o", tmp_path / "out"),
            stdout=subprocess.PIPE if is_pipe else full,
            stderr=subprocess.PIPE,
            text=True,
        )
    if is_pipe:
        assert process.stdout is not None
        process.stdout.close()
    _, messages = process.communicate()
    assert process.returncode == 1
    assert sorted(contents(tmp_path / "out")) == ["a.mcap", "b.mcap", "c.mcap"]
    problem = "Error: the standard output cannot be written (No space left on device). Hint: "
    errors = [line for line in messages.splitlines() if not line.startswith(("a", "b", "c"))]
    assert [line[: len(problem)] for line in errors] == ([] if is_pipe else [problem])


def test_folders_patterns_and_files(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    day("b", "a", "c10", "c9")
    (tmp_path / "day" / "._b.mcap").write_text("of another system")
    (tmp_path / "day" / "deep").mkdir()
    (tmp_path / "day" / "a.mcap").rename(tmp_path / "day" / "deep" / "a.mcap")
    monkeypatch.chdir(tmp_path)
    for names, found in (
        (["day"], ["b", "c9", "c10"]),
        (["day/c*.mcap", "day", "day/b.mcap"], ["c9", "c10", "b"]),
        (["day/**/*.mcap"], ["b", "c9", "c10", "deep/a"]),
    ):
        result = locatk("solve", *names, "-o", "out", "--json", "--overwrite")
        assert result.exit_code == 0, result.stderr
        told = entries(result.stdout)
        assert [entry["session"] for entry in told] == [f"day/{name}.mcap" for name in found]
        assert [entry["output"] for entry in told] == [
            f"out/{Path(name).name}.mcap" for name in found
        ]
    assert locatk("solve", "day", "-o", "solved.mcap").exit_code == 2
    one = locatk("solve", "day/deep", "-o", "one")  # a folder of one session is a folder
    assert one.exit_code == 0
    assert set(contents(tmp_path / "one")) == {"a.mcap"}


def test_other_files_in_a_folder(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pipes that nobody feeds, folders called like sessions, links in a circle, odd bytes."""
    [session] = day("a")
    folder = session.parent
    os.mkfifo(folder / "pipe.mcap")
    (folder / "old.mcap").mkdir()
    (folder / "round").symlink_to(folder)
    (folder / "around").symlink_to(tmp_path)
    Path(os.fsdecode(os.fsencode(folder) + b"/z\xff.mcap")).write_bytes(session.read_bytes())
    monkeypatch.chdir(tmp_path)
    for number, name in enumerate(("day", "**/*.mcap", "day/**", f"{tmp_path}/d*/**/*.mcap")):
        result = locatk("solve", name, "-o", f"out{number}", "--json")
        assert result.exit_code == 3, result.stderr
        a, pipe, odd = entries(result.stdout)
        assert a["poses"] > 0
        assert pipe["error"] == "not a regular file"
        assert odd["error"] == "the file name is not UTF-8"
        (tmp_path / f"out{number}" / "a.mcap").unlink()
    twice = locatk("solve", "day/a.mcap", "day/round/a.mcap", "-o", "twice", "--json")
    assert len(entries(twice.stdout)) == 1
    (folder / "deep").mkdir()
    session.rename(folder / "deep" / "a.mcap")
    day("a")
    named = locatk("solve", "day/a.mcap", "day/deep/a.mcap", "-o", "twins")
    assert named.exit_code == 2
    assert "day/a.mcap and day/deep/a.mcap would have the same output" in named.stderr


def test_outputs_are_next_to_the_sessions_by_default(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path
) -> None:
    sessions = day("a", "b")
    folder = tmp_path / "day"
    assert locatk("solve", sessions[0]).exit_code == 0
    assert read_solution(folder / "a-solved.mcap").poses == 20
    result = locatk("solve", folder, "-v")  # a solution is there already
    assert result.exit_code == 1
    assert f"Skipped {folder / 'a-solved.mcap'}: a solution\n" in result.stderr
    assert "a-solved.mcap: output exists. Hint: Add --overwrite" in result.stderr
    assert locatk("solve", folder, "--overwrite").exit_code == 0
    everything = sorted(folder.glob("*.mcap"))  # as a shell expands it
    again = locatk("solve", *everything, "--resume", "--json")
    assert again.exit_code == 0, again.stderr
    assert [entry["session"] for entry in entries(again.stdout)] == [str(s) for s in sessions]
    assert set(contents(folder)) == {
        f"{name}{end}.mcap" for name in "ab" for end in ("", "-solved")
    }
    # Named by itself it is no session.
    assert locatk("solve", folder / "a-solved.mcap", "-o", tmp_path / "no.mcap").exit_code == 1


@pytest.mark.slow
def test_results_do_not_depend_on_jobs(
    locatk: Run, tmp_path: Path, record: Callable[..., Path], sonar: Path
) -> None:
    """Real solvers, real processes, and among the sessions what is none."""
    folder = tmp_path / "day"
    folder.mkdir()
    short = {"polaris": (), "lighthouse": ("--duration", 3), "dots": ("--frames", 3)}
    for system, args in short.items():
        assert locatk("simulate", system, "-o", folder / f"{system}.mcap", *args).exit_code == 0
    (folder / "empty.mcap").touch()
    (folder / "cut.mcap").write_bytes((folder / "polaris.mcap").read_bytes()[:-100])
    (folder / "solution.mcap").write_bytes(b"")
    solved = locatk("solve", folder / "polaris.mcap", "-o", folder / "solution.mcap", "--overwrite")
    assert solved.exit_code == 0
    from mcap.writer import Writer

    with open(folder / "foreign.mcap", "wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    record(folder / "still.mcap", ("red",), "sonar")
    record(folder / "broken.mcap", ("red",), "sonar")
    outputs, told, errors = [], [], []
    for jobs in (1, 4):
        out = tmp_path / f"out{jobs}"
        result = locatk("solve", folder, "-o", out, "--jobs", jobs, "--json")
        assert result.exit_code == 3, result.stderr
        outputs.append(contents(out))
        said = result.stdout.replace(f"out{jobs}", "out")
        told.append([{**entry, "solve_s": 0} for entry in entries(said)])
        errors.append(result.stderr)
    assert set(outputs[0]) == {"polaris.mcap", "lighthouse.mcap", "dots.mcap"}
    assert outputs[0] == outputs[1]
    assert told[0] == told[1]
    assert errors[0] == errors[1]
    reasons = {Path(entry["session"]).stem: entry.get("error") for entry in told[0]}
    names = ["broken", "cut", "dots", "empty", "foreign", "lighthouse", "polaris", "still"]
    assert list(reasons) == names
    assert [name for name in names if reasons[name] is None] == ["dots", "lighthouse", "polaris"]
    assert reasons["broken"] == "internal error, ZeroDivisionError: by nought"
    assert "Please report it, with the traceback from -v" in errors[0]
    assert "Incomplete: 5 of 8 sessions could not be solved." in errors[0]


def test_the_solution_names_its_origin(
    locatk: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").mkdir()
    assert locatk("simulate", "polaris", "-o", "my run.mcap").exit_code == 0
    args = ("--method", "paper", "--speed", 0.1)
    for place in ("solved.mcap", "other/named.mcap"):
        assert locatk("solve", "my run.mcap", "-o", place, *args).exit_code in (0, 3)
    assert Path("solved.mcap").read_bytes() == Path("other/named.mcap").read_bytes()
    facts = Session.open("solved.mcap").facts
    assert facts["command"] == "locatk solve 'my run.mcap' --method paper --speed 0.1"
    assert facts.items() >= source_facts("my run.mcap").items()


@pytest.mark.slow
def test_a_deadly_session_does_not_stop_the_batch(
    day: Callable[..., list[Path]], tmp_path: Path, sonar: Path
) -> None:
    """Its processes talk by a socket, whose path is short, but their folder may be long."""
    long = tmp_path / ("x" * 90)
    long.mkdir()
    sessions = day("a", "deadly", "b", "c")
    out = tmp_path / "out"
    arguments = command("solve", *sessions, "-o", out, "--jobs", 2, "--json")
    env = {**os.environ, "TMPDIR": str(long)}
    done = subprocess.run(arguments, capture_output=True, text=True, env=env)
    assert done.returncode == 3, done.stderr
    told = entries(done.stdout)
    assert [entry["session"] for entry in told] == [str(session) for session in sessions]
    assert [entry.get("error") for entry in told] == [None, "its process died 2 times", None, None]
    assert f"{sessions[1]}: its process died 2 times. Hint: " in done.stderr
    assert "Traceback" not in done.stderr
    assert set(contents(out)) == {"a.mcap", "b.mcap", "c.mcap"}


@pytest.mark.slow
def test_resume_skips_solved_sessions(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, sonar: Path
) -> None:
    sessions = day("a", "b", "c", "still")
    out = tmp_path / "out"
    scene = tmp_path / "scene.toml"
    scene.write_text("of the sonar")
    artifact = tmp_path / "map.txt"
    artifact.write_text("one")

    def resume(*more: object) -> tuple[list[Any], list[str]]:
        before = len(calls(sonar))
        result = locatk("solve", tmp_path / "day", "-o", out, "--resume", "--json", *more)
        assert result.exit_code == 3, result.stderr
        told = entries(result.stdout)
        assert [entry["session"] for entry in told] == [str(session) for session in sessions]
        assert [entry.get("poses") for entry in told] == [20, 40, 60, None]
        return [entry.get("resumed") for entry in told], calls(sonar)[before:]

    first = locatk("solve", *sessions[:2], "-o", out)
    assert first.exit_code == 0
    refused = locatk("solve", tmp_path / "day", "-o", out)  # unasked, nothing is replaced
    assert refused.exit_code == 1
    assert calls(sonar) == ["a", "b"]
    assert resume() == ([True, True, False, None], ["c", "still"])
    done = contents(out)
    os.utime(sessions[0])  # touched, copied: the same
    sessions[1].rename(tmp_path / "moved")
    (tmp_path / "moved").rename(sessions[1])
    assert resume("--jobs", 2) == ([True, True, True, None], ["still"])
    assert contents(out) == done
    (out / "a.mcap").write_bytes(done["a.mcap"][:-50])  # a copy that was cut off
    (out / "b.mcap").write_bytes(b"")
    assert resume() == ([False, False, True, None], ["a", "b", "still"])
    assert contents(out) == done
    again = (False, False, False, None)
    assert resume("--artifact", artifact)[0] == list(again)
    assert resume("--artifact", artifact)[0] == [True, True, True, None]
    artifact.write_text("two")
    assert resume("--artifact", artifact)[0] == list(again)


def test_resume_replaces_nothing_of_others(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, sonar: Path
) -> None:
    day("a", "b")
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.mcap").write_text("precious")
    result = locatk("solve", tmp_path / "day", "-o", out, "--resume")
    assert result.exit_code == 3
    assert "a.mcap: output exists. Hint: Add --overwrite" in result.stderr
    assert (out / "a.mcap").read_text() == "precious"
    assert calls(sonar) == ["b"]
    assert locatk("solve", tmp_path / "day", "-o", out, "--resume", "--overwrite").exit_code == 0
    assert calls(sonar) == ["b", "a"]


def test_an_attempt_thought_lost_does_no_harm(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that nobody hears from any more writes the output all the same, meanwhile."""
    [session] = day("a")
    out = tmp_path / "a.mcap"
    job = solving.plan_job(str(session), str(out), SolveRequest())
    solve = solving.solve_session

    def twice(path: Path, request: SolveRequest) -> SolvedSession:
        monkeypatch.setattr(solving, "solve_session", solve)
        assert isinstance(solving.run_job(job), SolveReport)
        return solve(path, request)

    monkeypatch.setattr(solving, "solve_session", twice)
    report = solving.run_job(job)
    assert isinstance(report, SolveReport)
    assert report.poses == 20
    whole = out.read_bytes()
    again = solving.run_job(job)  # once more, afterwards
    assert isinstance(again, SolveReport)
    assert again.solve_s is None
    assert out.read_bytes() == whole
    out.write_text("precious")
    failure = solving.run_job(job)
    assert isinstance(failure, SolveFailure)
    assert "exists" in failure.error.message
    assert out.read_text() == "precious"


def test_a_broken_artifact_is_one_error(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, sonar: Path
) -> None:
    sessions = day("a", "b")
    artifact = tmp_path / "tag.toml"
    for text in ("not toml", 'format = "locatk-lighthouse-scene"\nformat_version = "x"'):
        artifact.write_text(text)
        result = locatk("solve", *sessions, "-o", tmp_path / "out", "--artifact", artifact)
        assert not (tmp_path / "out").exists()
        assert result.exit_code == 1
        assert result.stderr.count("\n") == 1
        assert "tag.toml" in result.stderr
    assert calls(sonar) == []


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_an_interrupt_keeps_complete_solutions(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, sonar: Path, jobs: int
) -> None:
    day("a", "b", "slow", "z")
    out, scratch = tmp_path / "out", tmp_path / "scratch"
    scratch.mkdir()
    arguments = ("solve", tmp_path / "day", "-o", out)
    batch = subprocess.Popen(
        command(*arguments, "--jobs", jobs),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "TMPDIR": str(scratch)},
    )
    wait_for((sonar / "slow").exists)
    if jobs == 2:  # the other process goes on
        wait_for((out / "z.mcap").exists)
    worker = int((sonar / "slow").read_text())
    os.killpg(batch.pid, signal.SIGINT)  # as the terminal does
    stdout, stderr = batch.communicate(timeout=20)
    assert batch.returncode == 130
    assert stdout.count(" -> ") == 2  # z is solved, but its turn has not come
    assert stderr == (
        "Interrupted after 2 of 4 sessions. Hint: Repeat the command with --resume to solve the "
        "others.\n"
        "\nAborted\n"
    )
    if jobs == 2:
        wait_for(lambda: not Path(f"/proc/{worker}").exists())
    assert set(contents(out)) == {f"{n}.mcap" for n in ("a", "b", *("z" * (jobs - 1)))}
    assert temporary(scratch) == []
    (sonar / "go").touch()
    done = locatk(*arguments, "--resume", "--json")
    assert done.exit_code == 0, done.stderr
    resumed = [True, True, False, jobs == 2]
    assert [entry["resumed"] for entry in entries(done.stdout)] == resumed


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes")
@pytest.mark.parametrize("after_s", [0.0, 0.3])
def test_an_interrupt_while_processes_start(
    day: Callable[..., list[Path]], tmp_path: Path, after_s: float
) -> None:
    """The terminal interrupts all of them; only the command answers."""
    day("a", "b", "slow", "z")
    out = tmp_path / "out"
    batch = subprocess.Popen(
        command("solve", tmp_path / "day", "-o", out, "--jobs", 2),
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    wait_for(out.exists)  # made before any process is started
    time.sleep(after_s)
    os.killpg(batch.pid, signal.SIGINT)
    _, stderr = batch.communicate(timeout=20)
    assert batch.returncode == 130
    assert stderr.splitlines()[-1] == "Aborted"
    assert "Traceback" not in stderr


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@pytest.fixture
def cluster(tmp_path: Path, sonar: Path) -> Iterator[str]:
    """A Dask scheduler and two workers of one thread in processes of their own."""
    pytest.importorskip("distributed", reason="dask is not installed")
    address = f"tcp://127.0.0.1:{free_port()}"
    folder = tmp_path / "dask"
    folder.mkdir()
    start = [sys.executable, "-m", "dask"]
    arguments = [[*start, "scheduler", "--host", address, "--no-dashboard"]]
    worker = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder)]
    arguments += [[*start, "worker", address, *worker]] * 2
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    started = [subprocess.Popen(each, cwd=folder, **quiet) for each in arguments]  # type: ignore[call-overload]
    try:
        yield address
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_cluster_loses_nothing_when_a_worker_is_killed(
    locatk: Run, cluster: str, day: Callable[..., list[Path]], tmp_path: Path, sonar: Path
) -> None:
    sessions = day("a", "b", "slow", "still", "c", "d", "e")
    out, serial = tmp_path / "out", tmp_path / "serial"
    artifact = tmp_path / "map.txt"
    artifact.write_text("one")
    options = ("--artifact", artifact, "--json")
    batch = subprocess.Popen(
        command("solve", "day", "-o", "out", "--scheduler", cluster, *options),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,  # workers are elsewhere
    )
    wait_for((sonar / "slow").exists)
    os.kill(int((sonar / "slow").read_text()), signal.SIGKILL)
    (sonar / "go").touch()
    stdout, stderr = batch.communicate(timeout=40)
    assert batch.returncode == 3, stderr
    told = entries(stdout)
    assert [tmp_path / entry["session"] for entry in told] == sorted(sessions)
    assert [entry["session"] for entry in told if "error" in entry] == ["day/still.mcap"]
    assert stderr == (
        "Error: day/still.mcap: one robot standing still. Hint: Drive it around.\n"
        "Incomplete: 1 of 7 sessions could not be solved.\n"
    )
    assert calls(sonar).count("slow") == 2
    result = locatk("solve", tmp_path / "day", "-o", serial, *options)
    assert result.exit_code == 3
    assert len(contents(out)) == 6
    assert contents(out) == contents(serial)


@pytest.mark.slow
@pytest.mark.usefixtures("sonar")
def test_an_unresponsive_server_is_named(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="dask is not installed")
    from locatk.formats.pipeline import execution

    monkeypatch.setattr(execution, "SCHEDULER_TIMEOUT_S", 0.2)
    sessions = day("a", "b")
    address = f"tcp://127.0.0.1:{free_port()}"
    result = locatk("solve", *sessions, "-o", tmp_path / "out", "--scheduler", address)
    assert result.exit_code == 1
    assert result.stderr.startswith(f"Error: no Dask scheduler at {address}")
    assert f"`dask worker {address}`" in result.stderr
    assert result.stderr.count("\n") == 1
    with socket.create_server(("127.0.0.1", 0)) as deaf:  # takes connections, never answers
        for address in (
            f"tcp://127.0.0.1:{deaf.getsockname()[1]}",
            "host",
            "tls://host:1",
            "x://y",
        ):
            result = locatk("solve", *sessions, "-o", tmp_path / "out", "--scheduler", address)
            assert result.exit_code == 1
            assert result.stderr.startswith(f"Error: no Dask scheduler at {address} (")
            assert result.stderr.count("\n") == 1


def test_missing_extras_are_one_line(
    locatk: Run, day: Callable[..., list[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sessions = day("a", "b")
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    for args, extra in (
        ([*sessions, "--scheduler", "tcp://host:8786"], "dask"),
        (["s3://bucket/run.mcap"], "s3"),
        ([*sessions, "-o", "s3://bucket/out"], "s3"),
    ):
        result = locatk("solve", *args)
        assert result.exit_code == 1
        assert result.stderr.count("\n") == 1
        assert f'Hint: Install it: pip install "locatk[{extra}]".' in result.stderr


@pytest.fixture(scope="module")
def s3_server() -> Iterator[str]:
    """The URL of an S3 server."""
    moto = pytest.importorskip("moto.server", reason="moto[server] is not installed")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    yield "http://{}:{}".format(*server.get_host_and_port())
    server.stop()


@pytest.fixture
def bucket(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """An empty bucket `lab` of a server without others, as file system."""
    s3fs = pytest.importorskip("s3fs", reason="s3fs is not installed")
    url = s3_server
    urllib.request.urlopen(f"{url}/moto-api/reset", data=b"").close()
    monkeypatch.setenv("AWS_ENDPOINT_URL", url)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "testing")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    s3fs.S3FileSystem.clear_instance_cache()
    try:
        store = s3fs.S3FileSystem(use_listings_cache=False, skip_instance_cache=True)
        store.mkdir("lab")
        yield store
    finally:
        s3fs.S3FileSystem.clear_instance_cache()


@pytest.mark.slow
@pytest.mark.usefixtures("sonar")
def test_s3_in_and_out(
    locatk: Run,
    bucket: Any,
    day: Callable[..., list[Path]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    sessions = day("a", "b", "c", "still")
    for session in sessions:
        bucket.put_file(str(session), f"lab/day/{session.name}")
    bucket.pipe_file("lab/day/cut.mcap", sessions[0].read_bytes()[:-100])
    bucket.pipe_file("lab/day/notes.txt", b"not a session")
    args = ("solve", "s3://lab/day/*.mcap", "-o", "s3://lab/out", "--json")
    done = subprocess.run(command(*args, "--jobs", 2), capture_output=True, text=True)
    assert done.returncode == 3, done.stderr
    assert str(tmp_path) not in done.stdout + done.stderr  # no word of temporary files
    told = {entry["session"]: entry for entry in entries(done.stdout)}
    names = ["a", "b", "c", "cut", "still"]
    assert list(told) == [f"s3://lab/day/{name}.mcap" for name in names]
    assert told["s3://lab/day/a.mcap"]["output"] == "s3://lab/out/a.mcap"
    assert "cut short" in told["s3://lab/day/cut.mcap"]["error"]
    assert "`locatk recover s3://lab/day/cut.mcap" in told["s3://lab/day/cut.mcap"]["hint"]
    assert "s3://lab/day/still.mcap: one robot standing still. Hint: " in done.stderr

    assert locatk("solve", *sessions[:3], "-o", tmp_path / "out").exit_code == 0
    assert sorted(bucket.ls("lab/out", detail=False)) == [f"lab/out/{n}.mcap" for n in "abc"]
    stored = {f"{name}.mcap": bucket.cat_file(f"lab/out/{name}.mcap") for name in "abc"}
    assert stored == contents(tmp_path / "out")

    assert locatk(*args).exit_code == 1  # nothing is replaced unasked
    resumed = locatk(*args, "--resume")
    assert resumed.exit_code == 3
    assert [entry.get("resumed") for entry in entries(resumed.stdout)] == [True] * 3 + [None] * 2
    bucket.pipe_file("lab/out/a.mcap", stored["a.mcap"][:-10])
    resumed = locatk(*args, "--resume")
    assert [entry.get("resumed") for entry in entries(resumed.stdout)][:3] == [False, True, True]
    assert bucket.cat_file("lab/out/a.mcap") == stored["a.mcap"]
    assert temporary(tmp_path) == []


@pytest.mark.slow
@pytest.mark.usefixtures("sonar")
def test_s3_locations(
    locatk: Run, bucket: Any, day: Callable[..., list[Path]], tmp_path: Path
) -> None:
    [session] = day("a")
    bucket.put_file(str(session), "lab/day/a.mcap")
    bucket.pipe_file("lab/other/notes.txt", b"not a session")
    assert locatk("solve", "s3://lab/day/a.mcap").exit_code == 0  # beside it
    again = locatk("solve", "s3://lab/day", "--overwrite", "-v")
    assert again.exit_code == 0, again.stderr
    assert "Skipped s3://lab/day/a-solved.mcap: a solution" in again.stderr
    assert locatk("solve", "s3://lab/day/a.mcap", "-o", tmp_path / "a.mcap").exit_code == 0
    assert (tmp_path / "a.mcap").read_bytes() == bucket.cat_file("lab/day/a-solved.mcap")
    assert locatk("solve", session, "-o", "s3://lab/new.mcap").exit_code == 0
    assert bucket.exists("lab/new.mcap")
    for output in ("s3://nobucket/new.mcap", "s3://nobucket/out/"):
        refused = locatk("solve", session, "-o", output)
        assert refused.exit_code == 1
        assert refused.stderr.startswith(f"Error: {output}")
        assert ": no such bucket 'nobucket'. Hint: " in refused.stderr
    for place, words in (
        ("s3://lab/day/none.mcap", "Error: s3://lab/day/none.mcap: No such object"),
        ("s3://lab/other/", "Error: s3://lab/other/: no *.mcap in the folder"),
        ("s3://lab/x*.mcap", "Error: s3://lab/x*.mcap: no file matches the pattern"),
        ("s3://nobucket/a.mcap", "s3://nobucket/a.mcap"),
        ("s5://lab/a.mcap", "s5"),
    ):
        result = locatk("solve", place, "-o", tmp_path / "no.mcap")
        assert result.exit_code == 1
        assert words in result.stderr
        assert result.stderr.count("\n") == 1
        assert result.stderr.startswith("Error: ")


@pytest.mark.slow
def test_a_batch_is_a_line_a_session(
    locatk: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "day").mkdir()
    for k in (1, 2, 10):
        options = ("--duration", "3", "--seed", k)
        locatk("simulate", "lighthouse", *options, "-o", f"day/r{k}.mcap")
    (tmp_path / "day" / "r3.mcap").touch()
    result = locatk("solve", "day", "-o", "solved")
    assert result.exit_code == 3
    lines = result.stdout.splitlines()
    assert [line.split(" -> ")[0] for line in lines] == [f"day/r{n}.mcap" for n in (1, 2, 10)]
    assert result.stderr.count("no factory calibration") == 1
    assert "3 of 3 sessions, as r1.mcap: no factory calibration" in result.stderr
    table = [line.split(maxsplit=1) for line in result.stderr.splitlines()[-3:-1]]
    assert table == [["session", "problem"], ["day/r3.mcap", "the file is empty"]]
    quiet = locatk("solve", "day", "-o", "solved", "--overwrite", "-q")
    assert quiet.exit_code == 3
    assert quiet.stdout == ""
    assert [line.split(":")[0] for line in quiet.stderr.splitlines()] == ["Error", "Incomplete"]
    verbose = locatk("solve", "day", "-o", "solved", "--overwrite", "-v")
    assert verbose.stdout.count("sigma x") == 3
