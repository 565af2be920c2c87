"""``locatk demo``: the whole way once, on simulated data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options


@click.command(short_help="Simulate, solve and evaluate, to see that all works.")
@options.output("Folder for session, solution and plot. [default: a new one]", required=False)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True)
@options.overwrite
@options.as_json
@options.verbosity
def command(output: Path | None, seed: int, overwrite: bool, as_json: bool) -> None:
    """Simulate a session of each system, solve it, and compare it with the truth.

    Here: two robots driving under two Lighthouse stations whose places are unknown.
    Writes the session, the solution and a plot.

    \b
    Examples:
      locatk demo
      locatk demo -o demo
      locatk demo --seed 7 --json
    """
    folder = _folder(output)
    rows = [_lighthouse(folder, seed, overwrite)]
    if as_json:
        console.emit_json({"version": 1, "systems": rows})
        return
    console.result(
        console.table(
            ("system", "poses", "error [mm]", "published algorithm [mm]", "time [s]"),
            [
                (
                    row["system"],
                    row["poses"],
                    f"{1e3 * row['mae_m']:.2f}",
                    f"{1e3 * row['paper_mae_m']:.2f}",
                    f"{row['solve_s']:.2f}",
                )
                for row in rows
            ],
        )
    )
    console.say("error: mean distance from the truth, in the frame of the simulated markers")
    for row in rows:
        for file in row["files"]:
            console.say(f"Wrote {file}")


def _folder(output: Path | None) -> Path:
    import tempfile

    if output is None:
        return Path(tempfile.mkdtemp(prefix="locatk-demo-"))
    options.make_folder(output)
    return output


def _lighthouse(folder: Path, seed: int, overwrite: bool) -> dict[str, Any]:
    from locatk.cli.systems import Request, solve_session
    from locatk.core import metrics
    from locatk.core.lighthouse.simulate import SimulationOptions, simulate
    from locatk.formats import observations, solutions
    from locatk.formats.plot import plot_solution

    session, solution, picture = (
        folder / f"lighthouse{end}" for end in (".mcap", "-solved.mcap", ".png")
    )
    for path in (session, solution, picture):
        options.guard_output(path, overwrite=overwrite)

    with console.working("Simulating"):
        simulated = simulate(
            SimulationOptions(robots=2, stations=2, planar=True, duration_s=60.0, seed=seed)
        )
        observations.write_session(
            session,
            system="lighthouse",
            sweeps=simulated.sweeps,
            scene=simulated.scene,
            truth=simulated.truth,
            overwrite=overwrite,
        )
    with console.working("Solving"):
        solved = solve_session(session, Request())
        paper = solve_session(session, Request(method="paper"))
        solutions.write_solution(solution, solved.solution, source=session, overwrite=overwrite)

    truth = {trajectory.device: trajectory for trajectory in simulated.truth}

    def error(of: Any) -> float:
        pairs = [(mine, truth[mine.device]) for mine in of.solution.trajectories]
        return metrics.evaluate_all(pairs).mae

    with console.working("Drawing"):
        plot_solution(picture, solved.solution, truth=simulated.truth, overwrite=overwrite)
    return {
        "system": "lighthouse",
        "poses": solved.solution.poses,
        "mae_m": error(solved),
        "paper_mae_m": error(paper),
        "solve_s": solved.solve_s,
        "files": [str(session), str(solution), str(picture)],
    }
