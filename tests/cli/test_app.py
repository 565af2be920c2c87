"""The command as a whole: help, start-up, errors and exit statuses."""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import shlex
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from locatk.cli import app as app_module
from locatk.cli import calibrate, console, failures
from locatk.cli.app import COMMANDS, app
from locatk.cli.command import GENERAL_OPTIONS, Command
from locatk.core import errors

Run = Callable[..., Result]


def every_command(command: click.Command = app, path: tuple[str, ...] = ()) -> Iterator[tuple]:
    """Yield (path, command) of each command below the group."""
    if path:
        yield path, command
    if isinstance(command, click.Group):
        context = click.Context(command, **app.context_settings)
        for name in command.list_commands(context):
            child = command.get_command(context, name)
            assert child is not None
            yield from every_command(child, (*path, name))


@pytest.mark.parametrize("path", [path for path, _ in every_command()], ids=" ".join)
def test_every_help_has_valid_examples(
    locatk: Run, path: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each example of each help names commands and options that exist."""
    result = locatk(*path, "--help")
    assert result.exit_code == 0
    assert "Examples:" in result.stdout
    block = result.stdout.split("Examples:\n")[1].split("\n\n")[0]
    examples = [line.strip() for line in block.replace("\\\n", " ").splitlines()]
    assert [line for line in examples if not line.startswith("locatk ")] == []
    assert any(line.startswith("locatk " + " ".join(path)) for line in examples)
    monkeypatch.setattr(Path, "exists", lambda self, **_: True)
    monkeypatch.delenv("LOCATK_DATA", raising=False)
    for line in examples:
        args = shlex.split(line)[1:]
        if ">" in args:  # The shell redirects the output.
            args = args[: args.index(">")]
        context = click.Context(app, **app.context_settings)
        command: click.Command = app
        while isinstance(command, click.Group):
            found = command.get_command(context, args.pop(0))
            assert found is not None, line
            command = found
        with contextlib.suppress(click.exceptions.Exit):  # An option that prints and ends.
            command.make_context("example", args, parent=context, resilient_parsing=False)
    console.reset()


LEAVES = [
    (" ".join(path), command)
    for path, command in every_command()
    if not isinstance(command, click.Group)
]

MAX_UNDIVIDED_OPTIONS = 8
"""Most options of a command without sections, apart from those that most commands have."""


def context_of(path: str, command: click.Command) -> click.Context:
    parent = click.Context(app, info_name="locatk", **app.context_settings)
    return click.Context(command, info_name=path, parent=parent, terminal_width=80)


@pytest.mark.parametrize(("path", "command"), LEAVES, ids=[path for path, _ in LEAVES])
def test_every_option_has_a_section_and_help_of_80_columns(
    path: str, command: click.Command
) -> None:
    assert isinstance(command, Command)
    context = context_of(path, command)
    parameters = [p for p in command.get_params(context) if isinstance(p, click.Option)]
    assert all(parameter.help for parameter in parameters)
    own = [p for p in parameters if not GENERAL_OPTIONS.intersection(p.opts)]
    general = [p for p in parameters if p not in own]
    sections = Counter(command.section_of(parameter) for parameter in own)
    assert sections["Options"] <= MAX_UNDIVIDED_OPTIONS
    assert len(own) <= MAX_UNDIVIDED_OPTIONS or len(sections) > 1
    assert {command.section_of(parameter) for parameter in general} == {"Options"}
    text = command.get_help(context)
    assert [line for line in text.splitlines() if len(line) > 80] == []
    titles = [line[:-1] for line in text.splitlines() if line.endswith(":") and line[0] != " "]
    assert {title for title in titles if title != "General"} == set(sections)
    assert text.count("\nGeneral:\n") == 1
    for parameter in parameters:
        assert text.count(f" {parameter.opts[-1]} ") + text.count(f" {parameter.opts[-1]}\n") > 0


@pytest.mark.parametrize("option", ["--json", "--quiet", "--verbose", "--overwrite", "--seed"])
def test_an_option_has_the_same_words_everywhere(option: str) -> None:
    texts = {
        path: parameter.help.split(".")[0]
        for path, command in LEAVES
        for parameter in command.get_params(context_of(path, command))
        if isinstance(parameter, click.Option) and option in parameter.opts
    }
    exceptions = {
        "--json": {"solve", "emulate", "live"},
        # Their settings have seeds of their own, which the text has to distinguish.
        "--seed": {"map design", "simulate polaris"},
    }.get(option, set())
    assert len({text for path, text in texts.items() if path not in exceptions}) == 1
    assert exceptions <= set(texts)


def test_tables_agree_with_commands() -> None:
    for table in (COMMANDS, calibrate.COMMANDS):
        for name, (module, short) in table.items():
            command = importlib.import_module(module).command
            assert command.short_help == short, name
            assert name in (
                command.name,
                module.rsplit(".", 1)[-1].rstrip("_"),
                module.split(".")[2],
            )


@pytest.mark.slow
@pytest.mark.parametrize("args", [["--help"], ["--version"], ["solve", "--help"], ["nonsense"]])
def test_start_up_is_light(args: list[str]) -> None:
    code = (
        "import sys\n"
        "from locatk.cli.app import app\n"
        f"try: app({args!r}, prog_name='locatk')\n"
        "except SystemExit: pass\n"
        "loaded = set(sys.modules)\n"
        "print(sorted(loaded & {'numpy', 'scipy', 'cv2', 'matplotlib', 'google.protobuf'}))\n"
        "print(sorted(m for m in loaded if m.startswith('locatk.')))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy, own = done.stdout.splitlines()[-2:]
    assert heavy == "[]"
    if args[0] == "--help":
        commands = {module for module, _ in COMMANDS.values()}
        assert not commands & set(eval(own))


def test_module_runs() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "locatk.cli", "--version"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith("locatk ")


def test_completion_needs_no_command_module() -> None:
    environment = {
        **os.environ,
        "_LOCATK_COMPLETE": "bash_complete",
        "COMP_WORDS": "locatk s",
        "COMP_CWORD": "1",
    }
    code = "import sys\nfrom locatk.cli.app import main\nmain()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert done.stdout.splitlines() == ["plain,site", "plain,simulate", "plain,solve"]


def failing(error: BaseException) -> Callable[..., Result]:
    """`locatk broken`, a command that raises ``error``."""

    @click.command()
    @click.option("-v", is_flag=True, callback=lambda c, p, v: console.set_verbosity(int(v)))
    def broken(v: bool) -> None:
        raise error

    def run(*args: str) -> Result:
        group = app_module.App("locatk", table=COMMANDS)
        group.get_command = lambda ctx, name: broken  # type: ignore[method-assign]
        return CliRunner().invoke(group, ["broken", *args], prog_name="locatk")

    return run


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (
            errors.FormatError("not MCAP", file="a.mcap", where=3, hint="Give a session"),
            1,
            "Error: a.mcap:3: not MCAP. Hint: Give a session.\n",
        ),
        (errors.DegenerateError("one robot\nstood still"), 1, "Error: one robot stood still.\n"),
        (
            PermissionError(errno.EACCES, "denied", "/x/y"),
            1,
            "Error: /x/y: Permission denied. Hint: Check the permissions of the file and of "
            "its folder.\n",
        ),
        (
            OSError(errno.ENOSPC, "full"),
            1,
            "Error: No space left on device. Hint: Free some space or write to another disk.\n",
        ),
        (
            IsADirectoryError(errno.EISDIR, "dir", "/x"),
            1,
            "Error: /x: Is a directory. Hint: Name a file, not a folder.\n",
        ),
        (
            ZeroDivisionError("division by zero"),
            1,
            "Error: internal error, ZeroDivisionError: division by zero. Hint: Please report "
            "it, with the traceback from -v.\n",
        ),
        (
            failures.Incomplete("2 sessions are unsolved"),
            3,
            "Incomplete: 2 sessions are unsolved.\n",
        ),
        (KeyboardInterrupt(), 130, "\nAborted\n"),
        (
            click.UsageError("Two are too many."),
            2,
            "Error: Two are too many. Hint: See `locatk broken --help`.\n",
        ),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_errors_are_one_line(error: BaseException, status: int, line: str) -> None:
    result = failing(error)()
    assert result.exit_code == status
    assert result.stderr == line
    assert result.stdout == ""


def test_verbose_shows_the_traceback() -> None:
    result = failing(ZeroDivisionError("oops"))("-v")
    assert "Traceback" in result.stderr
    assert result.stderr.splitlines()[-1].startswith("Error: internal error")
    assert "Traceback" not in failing(ZeroDivisionError("oops"))().stderr


def test_wrong_usage_is_one_line(locatk: Run) -> None:
    for args in (
        ["nonsense"],
        ["solve"],
        ["solve", "--nonsense"],
        ["import", "xyz", "a", "-o", "b"],
    ):
        result = locatk(*args)
        assert result.exit_code == 2, args
        assert result.stderr.startswith("Error: ")
        assert len(result.stderr.splitlines()) == 1
        assert "Hint: See `locatk " in result.stderr


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e999"])
@pytest.mark.parametrize(
    "given",
    [
        ("eval", "SESSION", "--truth", "SESSION", "--max-gap"),
        ("emulate", "SESSION", "--no-wait", "--speed"),
        ("emulate", "SESSION", "--no-wait", "--drop"),
        ("solve", "SESSION", "--speed"),
        ("calibrate", "camera", "SESSION", "-o", "camera.toml", "--focal-px"),
    ],
)
def test_numbers_are_finite(
    locatk: Run, session: Path, given: tuple[str, ...], number: str
) -> None:
    result = locatk(*(session if each == "SESSION" else each for each in given), number)
    assert result.exit_code == 2
    assert given[-1] in result.stderr
    assert "Traceback" not in result.stderr
    assert "internal error" not in result.stderr


def test_no_arguments_show_help(locatk: Run) -> None:
    result = locatk()
    assert result.exit_code == 2
    assert "Commands:" in result.stderr


def test_a_closed_pipe_is_quiet() -> None:
    done = subprocess.run(
        f"{sys.executable} -m locatk.cli --help | true",
        shell=True,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_termination_cleans_up(tmp_path: Path) -> None:
    """SIGTERM ends with 143, and a file in the making is removed."""
    code = (
        "import sys, time, click\n"
        "from locatk.cli import app as m\n"
        "from locatk.formats.output import atomic_write\n"
        "@click.command()\n"
        "def slow():\n"
        f"    with atomic_write({str(tmp_path / 'x.bin')!r}) as f:\n"
        "        f.write(b'1'); print('ready', flush=True); time.sleep(60)\n"
        "m.App.get_command = lambda self, ctx, name: slow\n"
        "sys.argv = ['locatk', 'slow']\n"
        "m.main()\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 143
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="streams of POSIX")
@pytest.mark.parametrize(
    ("closed", "status"), [("<&- >&- 2>&-", 1), ("<&- 2>&-", 0), ("2>/dev/full", 0)]
)
def test_files_are_written_without_standard_streams(
    session: Path, tmp_path: Path, closed: str, status: int
) -> None:
    output = tmp_path / "truth.tum"
    command = f"export {session} --format tum -o {output} {closed}"
    done = subprocess.run(
        f"{sys.executable} -m locatk.cli {command}", shell=True, capture_output=True, text=True
    )
    assert done.returncode == status, done.stderr
    assert len(output.read_text().splitlines()) == 20


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="streams of POSIX")
@pytest.mark.parametrize("command", ["--help", "export SESSION --format csv -o -"])
def test_results_on_a_closed_stdout_are_lost(session: Path, command: str) -> None:
    done = subprocess.run(
        f"{sys.executable} -m locatk.cli {command.replace('SESSION', str(session))} >&-",
        shell=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("Error: the standard output is closed")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("text", ["abc", "-1", "1e30", "9" * 12, "9" * 5000, "\u00b2"])
def test_an_impossible_source_date_is_refused(
    locatk: Run, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", text)
    result = locatk("tag", "--help")
    assert result.exit_code == 1
    assert "SOURCE_DATE_EPOCH is" in result.stderr
    assert result.stderr.count("\n") == 1
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    assert locatk("tag", "--help").exit_code == 0


@pytest.mark.parametrize("number", ["nan", "inf", "1e999"])
def test_options_are_finite(locatk: Run, tmp_path: Path, number: str) -> None:
    (tmp_path / "frame.png").write_bytes(b"")
    result = locatk("import", "images", tmp_path, "--rate", number, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 2
    assert "Invalid value for '--rate'" in result.stderr


@pytest.mark.parametrize(
    ("command", "flag"),
    [("solve", "--speed"), ("calibrate tag", "--speed"), ("calibrate camera", "--focal-px")],
)
@pytest.mark.parametrize("number", ["1e-308", "1e308"])
def test_numbers_whose_squares_overflow_are_refused(
    locatk: Run, session: Path, tmp_path: Path, command: str, flag: str, number: str
) -> None:
    output = tmp_path / f"out.{'mcap' if command == 'solve' else 'toml'}"
    result = locatk(*command.split(), session, "-o", output, flag, number)
    assert result.exit_code == 2
    assert f"Invalid value for '{flag}'" in result.stderr


@pytest.mark.parametrize("end", ["\n", "\r", "\u2028"])
def test_names_with_line_ends_are_refused(
    locatk: Run, session: Path, tmp_path: Path, end: str
) -> None:
    odd = tmp_path / f"a{end}b.mcap"
    odd.write_bytes(session.read_bytes())
    output = tmp_path / f"c{end}d.tum"
    for args, status, words in (
        (("info", odd), 2, "has a line end in its name"),
        (("export", session, "--format", "tum", "-o", output), 2, "has a line end in its name"),
        (("solve", odd, "-o", tmp_path / "out.mcap"), 1, "a line end in the file name"),
    ):
        result = locatk(*args)
        assert result.exit_code == status
        assert words in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert sorted(tmp_path.glob("*.tum")) == []


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_result_that_cannot_be_printed_is_an_error(session: Path) -> None:
    done = subprocess.run(
        f"{sys.executable} -m locatk.cli info {session} > /dev/full",
        shell=True,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(
        "Error: the standard output cannot be written (No space left on device). Hint: "
    )


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="streams of POSIX")
def test_closed_streams_do_not_receive_files(tmp_path: Path) -> None:
    """A file that is opened does not get the number of a closed stream."""
    code = (
        "from locatk.cli import app\n"
        "app.app = lambda **_: print(open('out', 'w').fileno(), file=open('number', 'w'))\n"
        "app.main()\n"
    )
    command = f'{sys.executable} -c "$CODE" <&- >&- 2>&-'
    subprocess.run(command, shell=True, cwd=tmp_path, env={**os.environ, "CODE": code}, check=True)
    assert int((tmp_path / "number").read_text()) > 2


@pytest.mark.slow
def test_an_encoding_without_the_character_is_no_error(tmp_path: Path, session: Path) -> None:
    named = session.rename(tmp_path / "机.mcap")
    done = subprocess.run(
        [sys.executable, "-m", "locatk.cli", "info", str(named)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONIOENCODING": "latin-1"},
    )
    assert done.returncode == 0
    assert r"\u673a.mcap" in done.stdout


HOSTILE = "red\x1b]0;x\x07\x9b2J\u202eder\u200b\rgo"


@pytest.mark.parametrize(
    "print_text",
    [
        console.say,
        console.detail,
        console.warn,
        console.result,
        lambda text: console.result(console.table(["device"], [[text]])),
        lambda text: console.result(console.labelled([("device", text)])),
        lambda text: failures.report(errors.LocatkError("bad", file=text, hint=text)),
        lambda text: failures.report(failures.Incomplete(text)),
        lambda text: failures.report(ValueError(text)),
        lambda text: failures.report(click.UsageError(text)),
    ],
)
def test_terminals_get_no_control_characters(
    print_text: Callable[[str], object],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    console.set_verbosity(1)
    try:
        print_text(HOSTILE)
    finally:
        console.reset()
    printed = "".join(capsys.readouterr())
    assert r"\x1b]0;x\x07" in printed
    assert r"\u202e" in printed
    assert printed.replace("\n", "").isprintable()


def test_the_end_of_a_stream_is_not_an_interrupt(
    locatk: Run, monkeypatch: pytest.MonkeyPatch, session: Path
) -> None:
    """click takes EOFError for Ctrl-D."""

    def fail(*_: object, **__: object) -> None:
        raise EOFError("pickle cut short")

    monkeypatch.setattr("locatk.formats.sessions.reader.Session.open", fail)
    result = locatk("info", session)
    assert result.exit_code == 1
    assert "internal error, EOFError: pickle cut short" in result.stderr


def test_a_warning_or_cell_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    console.warn("run\nError: fake.mcap")
    console.result(console.table(["device"], [["red\n-----"], ["green"]]))
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1
    assert printed.out.count("\n") == 3


def test_json_has_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    console.emit_json({"device": HOSTILE})
    line = capsys.readouterr().out
    assert line.rstrip("\n").isprintable()
    assert json.loads(line) == {"device": HOSTILE}


def test_no_color_is_honoured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert "\x1b[" in console.colour("x", "red")
    monkeypatch.setenv("NO_COLOR", "1")
    assert console.colour("x", "red") == "x"


def test_json_is_plain(capsys: pytest.CaptureFixture[str]) -> None:
    import numpy as np

    value = {
        "nan": float("nan"),
        "array": np.array([1.0, np.inf]),
        "count": np.int64(3),
        "flag": np.bool_(True),
        "path": Path("a/b"),
        "tuple": (1, None, "x"),
        2: "key",
    }
    console.emit_json(value)
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert json.loads(out) == {
        "nan": None,
        "array": [1.0, None],
        "count": 3,
        "flag": True,
        "path": "a/b",
        "tuple": [1, None, "x"],
        "2": "key",
    }


def test_table_aligns() -> None:
    text = console.table(("name", "n"), [("a", 1), ("long", 100), (None, "-")])
    assert text == "name    n\na       1\nlong  100\n        -"
    assert console.table(("a", "b"), []) == "a  b"
