"""The `locatk` command: a group that imports the module of a command when it is called.

``locatk --help`` prints the table below and imports none of the modules, so that it starts
quickly.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any

import click

from locatk.cli import console, failures
from locatk.cli.lazy import LazyGroup
from locatk.core.errors import InputError

COMMANDS = {
    "advise": ("locatk.cli.advise.command", "Compare the four systems for a task before buying."),
    "room": ("locatk.cli.room", "Place Lighthouse stations in a room, and check a room."),
    "camera": ("locatk.cli.camera", "Choose camera and lens for printed dots."),
    "tag": ("locatk.cli.tag", "Design magnetic tags, check them, encode and decode ids."),
    "array": ("locatk.cli.sensors.array", "Describe the magnetometers under a robot."),
    "halls": ("locatk.cli.sensors.halls", "Describe the hall sensors under a robot."),
    "receiver": ("locatk.cli.sensors.receiver", "Describe the photodiodes of a Lighthouse device."),
    "site": ("locatk.cli.site", "Place magnetic tags on a floor, check and survey them."),
    "map": ("locatk.cli.map", "Design floors of landmarks, check and exchange them."),
    "print": ("locatk.cli.print", "Draw dot sheets and templates at true size."),
    "capture": (
        "locatk.cli.capture.command",
        "Record a serial device or a camera into a session.",
    ),
    "live": (
        "locatk.cli.live.command",
        "Localize devices while they move, and publish the poses.",
    ),
    "emulate": ("locatk.cli.emulate", "Emulate a serial device on a pseudo-terminal."),
    "import": ("locatk.cli.import_.command", "Import recordings of other tools as a session."),
    "simulate": ("locatk.cli.simulate", "Simulate a session with ground truth."),
    "decode": ("locatk.cli.decode", "Decode the raw bytes of a recording again."),
    "recover": ("locatk.cli.recover", "Salvage a damaged recording."),
    "info": ("locatk.cli.info.command", "Describe a session, a solution or an artifact."),
    "calibrate": ("locatk.cli.calibrate", "Calibrate an artifact from recordings."),
    "solve": ("locatk.cli.solve.command", "Estimate poses from recorded sessions."),
    "eval": ("locatk.cli.eval.command", "Compare poses with ground truth."),
    "report": ("locatk.cli.report", "Write an HTML page about solutions."),
    "export": ("locatk.cli.export", "Write poses for other tools."),
    "demo": ("locatk.cli.demo.command", "Simulate, solve and evaluate, without hardware."),
    "bench": ("locatk.cli.bench", "Measure accuracy and speed against targets."),
}
"""Module and short help of each command. The module holds it as ``command``."""

TERMINATED_STATUS = 143
"""Exit status after SIGTERM: 128 and the number of the signal (POSIX shells)."""


MAX_SOURCE_DATE_S = 253_402_300_799
"""End of the year 9999 [s since 1970], the last that ``datetime`` has."""


class App(LazyGroup):
    """Group of :data:`COMMANDS` that reports errors in the format of locatk."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """Run a command and exit with its status; :mod:`locatk.cli.failures` reports errors."""
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, False, **extra)
        console.reset()
        try:
            _check_environment()
            status = super().main(args, prog_name, complete_var, False, **extra)
        except Exception as error:
            # click prints help without the console.
            is_of_stdout = isinstance(error, OSError) and console.lost_results() is not None
            status = 1 if is_of_stdout else failures.report(error)
        lost = console.lost_results()
        if lost is not None:
            status = failures.report_lost_results(lost)
        sys.exit(status if isinstance(status, int) else 0)


def _check_environment() -> None:
    """Raise InputError if SOURCE_DATE_EPOCH is not a time; libraries for PDF read it, too.

    Source: https://reproducible-builds.org/specs/source-date-epoch, which demands an error.
    """
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    if given and not (re.fullmatch("[0-9]{1,12}", given) and int(given) <= MAX_SOURCE_DATE_S):
        raise InputError(
            f"the environment variable SOURCE_DATE_EPOCH is {given[:20]!r}",
            hint="Set it to whole seconds since 1970, or unset it",
        )


def _show_version(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        from locatk.formats.output import tool_version

        console.write_result(f"locatk {tool_version()}\n")
        ctx.exit()


@click.group(
    cls=App,
    table=COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_show_version,
    help="Show the version and exit.",
)
def app() -> None:
    """Localization without satellites, motion capture or expensive sensors.

    Record or simulate a session, estimate poses from it, and compare them with ground truth.

    \b
    Examples:
      locatk demo
      locatk simulate lighthouse -o run.mcap
      locatk solve run.mcap -o solved.mcap
      locatk eval solved.mcap --truth run.mcap
    """


def _open_standard_streams() -> None:
    """Connect standard streams that are closed to the null device.

    Otherwise the next file that is opened gets the number of a closed stream, so that messages of
    libraries would be written into a recording. A closed stdin or stderr is as if ``/dev/null`` was
    given; a closed stdout stays one that cannot be written. A character that the encoding of a
    stream does not contain is escaped.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            # The lowest free number is opened, which is this one; programs that are started get it.
            access = os.O_RDONLY if name == "stdout" else os.O_RDWR
            os.set_inheritable(os.open(os.devnull, access), True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
        elif mode == "w":
            getattr(sys, name).reconfigure(errors="backslashreplace")


def main() -> None:
    """Run the `locatk` script."""
    _open_standard_streams()
    # With protobuf 6, each schema of foxglove warns that it was generated for protobuf 5.
    warnings.filterwarnings("ignore", message="Protobuf gencode version", category=UserWarning)
    # The matrices are small: more threads would only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # The signal raises an exception, so that unfinished files are removed.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED_STATUS))
    app(prog_name="locatk")
