"""``locatk simulate dots``: frames of a camera over a printed sheet."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from locatk.cli import console, options
from locatk.cli.simulate.options import simulation_command


@simulation_command("locatk.formats.simulation.dots")
def command(
    output: Path,
    settings: Mapping[str, Any],
    input_files: list[Path],
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate the paper's camera, 188 x 120 px of 0.046 mm, over a printed sheet.

    The session contains the frames, the manifest of the sheet, the camera, and as truth the
    position of the middle of each frame and its heading. The same settings and seed give the same
    frames.

    \b
    Examples:
      locatk simulate dots -o run.mcap
      locatk simulate dots -o run.mcap --sheet SHEET.toml --duration 20
      locatk simulate dots -o hard.mcap --path random --missing 0.05 --noise 8
      locatk simulate dots -o printed.mcap --printer-scale 1.002,0.998
      locatk simulate dots --print-config > sim.toml
      locatk simulate dots --config sim.toml -o run.mcap --seed 2
    """
    from locatk.formats.simulation import dots

    options.guard_output(output, overwrite=overwrite, inputs=input_files)
    summary = dots.write_simulation(
        output,
        settings,
        overwrite=overwrite,
        progress=lambda numbers: console.progress(numbers, "Rendering"),
    )
    console.result(
        f"Wrote {output}: {summary['frames']} frames of {summary['device']} over "
        f"{summary['frame']}, {summary['truth_poses']} truth poses"
    )
    if as_json:
        console.emit_json({"version": 1, "output": output, **summary})
