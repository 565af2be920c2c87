"""``locatk simulate lighthouse``: robots under Lighthouse stations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from locatk.cli import console, options
from locatk.cli.simulate.options import simulation_command


@simulation_command("locatk.formats.simulation.lighthouse")
def command(
    output: Path,
    settings: Mapping[str, Any],
    input_files: list[Path],
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate robots that drive or fly under Lighthouse stations into a session with truth.

    The same settings and seed give the same sweeps. The session contains markers, as a user would
    measure them, but not the stations: the solver estimates these. With --artifact, it contains the
    room instead, whose stations are beside their designed poses, by their mounting tolerance.

    \b
    Examples:
      locatk simulate lighthouse -o run.mcap
      locatk simulate lighthouse -o swarm.mcap --robots 20 --stations 4
      locatk simulate lighthouse -o hard.mcap --3d --occlusion 0.2 --seed 7
      locatk simulate lighthouse -o deck.mcap --3d --receiver deck
      locatk simulate lighthouse -o flight.mcap --flight --receiver deck
      locatk simulate lighthouse -o room.mcap --artifact room.toml --robots 5
      locatk simulate lighthouse --robots 20 --print-config > sim.toml
      locatk simulate lighthouse --config sim.toml -o swarm.mcap --seed 2
    """
    from locatk.formats.simulation import lighthouse

    options.guard_output(output, overwrite=overwrite, inputs=input_files)
    with console.working("Simulating"):
        summary = lighthouse.write_simulation(output, settings, overwrite=overwrite)
    console.result(
        f"Wrote {output}: {summary['sweeps']} sweeps, {summary['truth_poses']} truth poses"
    )
    if as_json:
        console.emit_json({"version": 1, "output": output, **summary})
