"""``locatk bench``: accuracy and speed beside targets and peers."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command

BENCHES = {
    "lighthouse": "locatk.formats.benchmarks.lighthouse.suite:figures",
    "dots": "locatk.formats.benchmarks.dots.suite:figures",
    "polaris": "locatk.formats.benchmarks.polaris.suite:figures",
    "landmarks": "locatk.formats.benchmarks.landmarks.suite:figures",
    "capture": "locatk.formats.benchmarks.capture:figures",
    "live": "locatk.formats.benchmarks.live:figures",
    "plan": "locatk.formats.benchmarks.plan.suite:figures",
    "look": "locatk.formats.benchmarks.look:figures",
    "infrared": "locatk.formats.benchmarks.infrared:figures",
}
"""Name of a system, or of a part, to the function that measures its figures."""

DEFAULT_DATA_FOLDER = Path("../shared/data")

TABLE_WIDTH = 80


@click.command(cls=Command, short_help="Measure accuracy and speed against targets.")
@click.argument("system", metavar="SYSTEM", type=click.Choice(list(BENCHES)))
@options.input_option(
    "--data",
    metavar="FOLDER",
    help="Folder with the published recordings.  "
    f"[default: $LOCATK_DATA, else {DEFAULT_DATA_FOLDER}]",
)
@click.option("--full", is_flag=True, help="Also print peers, machine factors and methods.")
@options.as_json
@options.verbosity
def command(system: str, data: Path | None, full: bool, as_json: bool) -> None:
    """Measure the figures of SYSTEM and print them beside their targets.

    \b
    SYSTEM is one of
      lighthouse, dots, polaris, landmarks
                  accuracy and speed of a system
      infrared    sweeps and factory data from raw infrared light
      capture     recording from ports, recovery of damaged files, decoding speed
      live        latency of live poses, agreement with solve, memory
      plan        predictions of the design commands against simulations
      look        eval compared with evo, reports, demo and batches

    Targets of durations are scaled by the machine factor: the duration of a fixed workload on this
    machine, measured with each figure, over that on the reference machine. A figure whose data
    are missing is listed without a value; --full gives the reason.

    \b
    Examples:
      locatk bench lighthouse
      locatk bench dots
      locatk bench polaris
      locatk bench landmarks
      locatk bench capture
      locatk bench live
      locatk bench plan
      locatk bench look
      locatk bench infrared
      locatk bench lighthouse --full
      locatk bench lighthouse --data ~/data --json
    """
    from locatk.formats.benchmarks.timing import machine_figures
    from locatk.formats.published_data import data_folder

    with console.working("Measuring"):
        figures = options.load(BENCHES[system])(data_folder(data) or DEFAULT_DATA_FOLDER)
        figures = [*figures, *machine_figures()]
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "system": system,
                "commit": _commit(),
                "figures": [_entry(f) for f in figures],
            }
        )
        return
    console.result(_narrow_table([_row(figure) for figure in figures]))
    if full:
        for figure in figures:
            console.result(f"\n{console.wrapped(figure.name)}\n{_details(figure)}")


def _entry(figure: Any) -> dict[str, Any]:
    """Return a figure as in ``--json``; ``target`` is the one scaled to this machine."""
    return {
        "name": figure.name,
        "value": figure.value,
        "unit": figure.unit,
        "target": figure.scaled_target,
        "better": figure.better,
        "met": figure.met,
        "peer": figure.peer,
        "peer_value": figure.peer_value,
        "how": figure.how,
        "workload": figure.workload,
        "machine_factor": figure.machine_factor,
        "reference_target": figure.target,
    }


def _row(figure: Any) -> tuple[str, ...]:
    sign = "<=" if figure.better == "lower" else ">="
    target = figure.scaled_target
    return (
        figure.name,
        _number(figure.value),
        "-" if target is None else f"{sign} {_number(target)}",
        figure.unit,
        {True: "yes", False: "no", None: "-"}[figure.met],
    )


def _details(figure: Any) -> str:
    """Format machine factor, peer and method of a figure."""
    rows = []
    if figure.machine_factor is not None:
        rows.append(("machine factor:", f"{figure.workload} {figure.machine_factor:.2f}"))
    if figure.peer:
        rows.append(("peer:", f"{_number(figure.peer_value)} {figure.unit} ({figure.peer})"))
    rows.append(("method:", figure.how))
    return console.labelled(rows, indent=2)


def _narrow_table(rows: list[tuple[str, ...]]) -> str:
    """Format rows in :data:`TABLE_WIDTH` columns; long names continue on the next line."""
    header = ("figure", "value", "target", "unit", "met")
    columns = zip(*(row[1:] for row in (header, *rows)), strict=True)
    widths = [max(map(len, column)) for column in columns]
    name_width = TABLE_WIDTH - sum(widths) - 2 * len(widths)
    lines: list[tuple[str, ...]] = []
    for name, *cells in rows:
        first, *others = textwrap.wrap(name, name_width, subsequent_indent="  ")
        lines.append((first, *cells))
        lines += [(other, *("" for _ in cells)) for other in others]
    return console.table(header, lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _commit() -> str | None:
    """Return the commit of the checkout that contains this module; None if installed."""
    import subprocess

    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():  # An installation may be inside another repository.
        return None
    try:
        process = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "--short=12", "HEAD"],
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return process.stdout.strip() or None if process.returncode == 0 else None
