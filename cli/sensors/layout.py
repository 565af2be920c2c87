"""Options and steps that the commands for layouts of sensors share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.command import section
from locatk.cli.map.options import Size
from locatk.cli.table_options import parse_words
from locatk.core.units import metres

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from locatk.formats.artifacts.schema import Artifact
    from locatk.formats.importers.sensor_csv import SensorTable

ENDINGS = {"pdf": (".pdf",), "svg": (".svg",)}

grid_option = click.option(
    "--grid",
    type=Size(),
    metavar="ROWSxCOLS",
    help="Grid with rows across the forward direction. Sensor 0 is the rightmost of the front row; "
    "the numbers go left, then back.",
)

pitch_option = click.option(
    "--pitch",
    type=options.PositiveNumber(1e-2, 1e4),
    metavar="MM",
    help="Distance between neighbouring sensors of --grid.",
)

positions_options = (
    options.input_option(
        "--positions", help="Table (.csv) of x, y and further columns, one row a sensor."
    ),
    click.option(
        "--units",
        metavar="UNIT",
        callback=parse_words,
        help="Unit of --positions, if the columns have none in their names: m, cm or mm.",
    ),
)

drawing_options = section(
    "Drawing",
    options.output_option(
        "--drawing", help="Also draw the sensors at true size.", endings=(".pdf", ".svg")
    ),
    click.option(
        "--size",
        default="A4",
        show_default=True,
        metavar="PAPER",
        help="Paper of the drawing: A0 to A5, Letter, Tabloid, or as in 600x900mm.",
    ),
)


def choose_one(**given: Any) -> str:
    """Return the name of the one option that is given.

    Raises
    ------
    click.UsageError
        None or several are.
    """
    names = [name for name, value in given.items() if value is not None]
    if len(names) != 1:
        flags = [f"--{name}" for name in given]
        raise click.UsageError(f"Give one of {', '.join(flags[:-1])} and {flags[-1]}.")
    return names[0]


def check_pitch(grid: tuple[int, int] | None, pitch: float | None) -> None:
    """Refuse a grid without a pitch, and a pitch without a grid."""
    if (grid is None) != (pitch is None):
        raise click.UsageError("--grid and --pitch belong together.")


def grid_positions(grid: tuple[int, int], pitch_mm: float) -> NDArray[np.float64]:
    """Return positions (n, 3) around the origin in metres, in the order of :data:`grid_option`."""
    import numpy as np

    rows, columns = grid
    forward, left = np.meshgrid(
        (rows - 1) / 2 - np.arange(rows), np.arange(columns) - (columns - 1) / 2, indexing="ij"
    )
    plane = np.column_stack([forward.ravel(), left.ravel(), np.zeros(rows * columns)])
    return plane * metres(pitch_mm)


def read_positions(path: Path, units: Sequence[str] | None) -> SensorTable:
    """Read the table of ``--positions``."""
    from locatk.formats.importers.sensor_csv import read_sensor_table

    return read_sensor_table(path, units or ())


def write_layout(
    artifact: Artifact[Any],
    sensors: Any,
    output: Path,
    *,
    labels: Sequence[str],
    position_m: NDArray[np.float64],
    title: str,
    drawing: Path | None,
    size: str,
    overwrite: bool,
    as_json: bool,
    positions: Path | None,
) -> None:
    """Check the sensors, write their artifact and drawing, and report.

    Raises
    ------
    ArtifactError
        The sensors could not be read again.
    InputError
        The drawing does not fit on the paper.
    """
    import numpy as np

    from locatk.formats.output import atomic_write

    text = artifact.dumps(sensors)
    artifact.loads(text, file=positions or output)
    inputs = [positions] if positions else []
    files = [output]
    contents = [text.encode()]
    if drawing is not None:
        paths, pages = _render(labels, position_m, size, title, drawing)
        files += paths
        contents += pages
    for path in files:
        options.guard_output(path, overwrite=overwrite, inputs=inputs)
    for path, data in zip(files, contents, strict=True):
        with atomic_write(path, overwrite=overwrite) as file:
            file.write(data)
    extent = np.ptp(position_m[:, :2], axis=0) * 1e3
    count = f"{len(labels)} sensor{'s' * (len(labels) > 1)}"
    console.result(f"Wrote {output}: {count} within {extent[0]:g} x {extent[1]:g} mm (x, y)")
    if drawing is not None:
        console.result(f"Wrote {', '.join(map(str, files[1:]))}")
        console.say("Print at 100 %, measure the rulers, and lay the drawing on the hardware.")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "outputs": files,
                "sensors": [
                    {"name": label, "position_mm": row}
                    for label, row in zip(labels, (position_m * 1e3).tolist(), strict=True)
                ],
            }
        )


def _render(
    labels: Sequence[str], position_m: NDArray[np.float64], size: str, title: str, drawing: Path
) -> tuple[list[Path], list[bytes]]:
    """Return the files of a drawing and their contents; SVG contains the plan only."""
    from locatk.core.drawing.sensor_layout import draw_sensor_layout
    from locatk.core.paper_sizes import paper_size
    from locatk.formats.printing.drawings import render_pages, render_svg

    _, paper_mm = paper_size(size)
    pages = draw_sensor_layout(labels, position_m, paper_mm, title=title)
    if drawing.suffix.lower() == ".svg":
        return [drawing], [render_svg(pages[0], title)]
    return [drawing], [render_pages(pages, title)]


def numbered(count: int) -> list[str]:
    """Return the numbers of sensors without names."""
    return [str(number) for number in range(count)]
