"""``locatk bench``: what the project promises, measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options

BENCHES = {
    "lighthouse": "locatk.formats.benchmarks.lighthouse:figures",
    "dots": "locatk.formats.benchmarks.dots.suite:figures",
    "polaris": "locatk.formats.benchmarks.polaris.suite:figures",
    "landmarks": "locatk.formats.benchmarks.landmarks.suite:figures",
    "capture": "locatk.formats.benchmarks.capture.suite:figures",
    "look": "locatk.formats.benchmarks.look.suite:figures",
    "infrared": "locatk.formats.benchmarks.infrared.suite:figures",
}
"""Name of a system, or of a part, to the function that measures its figures."""

ELSEWHERE = Path("../shared/data")


@click.command(short_help="Measure what the project promises, on published data.")
@click.argument("system", metavar="SYSTEM", type=click.Choice(list(BENCHES)))
@options.input_option(
    "--data",
    metavar="FOLDER",
    help=f"Folder with the published recordings.  [default: $LOCATK_DATA, else {ELSEWHERE}]",
)
@options.as_json
@options.verbosity
def command(system: str, data: Path | None, as_json: bool) -> None:
    """Measure the figures of SYSTEM and print them beside targets and peers.

    A figure whose data is not there is listed without a value, and with the reason.

    \b
    Examples:
      locatk bench lighthouse
      locatk bench dots
      locatk bench polaris
      locatk bench landmarks
      locatk bench capture
      locatk bench look
      locatk bench infrared
      locatk bench lighthouse --data ~/data --json
    """
    from locatk.formats.published_data import data_folder

    with console.working("Measuring"):
        figures = options.load(BENCHES[system])(data_folder(data) or ELSEWHERE)
    if as_json:
        rows = [{name: getattr(figure, name) for name in FIELDS} for figure in figures]
        console.emit_json({"system": system, "commit": _commit(), "figures": rows})
        return
    console.result(
        console.table(
            ("figure", "value", "target", "unit", "met", "peer", "peer's", "how"),
            [_row(figure) for figure in figures],
        )
    )


FIELDS = ("name", "value", "unit", "target", "better", "met", "peer", "peer_value", "how")
"""Of one figure, in the order of ``--json``."""


def _row(figure: Any) -> tuple[str, ...]:
    sign = "<=" if figure.better == "lower" else ">="
    return (
        figure.name,
        _number(figure.value),
        "-" if figure.target is None else f"{sign} {_number(figure.target)}",
        figure.unit,
        {True: "yes", False: "no", None: "-"}[figure.met],
        figure.peer or "-",
        _number(figure.peer_value),
        figure.how,
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _commit() -> str | None:
    """Commit of the checkout that this module lies in, None in an installed copy."""
    import subprocess

    here = Path(__file__).resolve().parent
    try:
        answer = subprocess.run(
            ["git", "-C", str(here), "rev-parse", "--short=12", "HEAD"],
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() or None if answer.returncode == 0 else None
