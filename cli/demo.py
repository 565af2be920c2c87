"""``locatk demo``: the whole way once, on simulated data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options

if TYPE_CHECKING:
    from locatk.core.trajectory import Trajectory

SYSTEMS = ("lighthouse", "dots", "polaris", "landmarks")

SPEED_MPS = 0.1
"""Of the robot over the tags; the published algorithm has to be told."""


@click.command(short_help="Simulate, solve and evaluate, to see that all works.")
@click.argument("systems", nargs=-1, metavar="[SYSTEM]...", type=click.Choice(SYSTEMS))
@options.output("Folder for sessions, solutions and plots. [default: a new one]", required=False)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    systems: tuple[str, ...], output: Path | None, seed: int, overwrite: bool, as_json: bool
) -> None:
    """Simulate a session of each SYSTEM, solve it, and compare it with the truth.

    Two robots drive under two Lighthouse stations whose places are unknown; a camera
    drives over a printed A4 sheet of dots, of which some are missing and some are dust; a
    bar of magnetometers drives over three tags of magnets that were laid by hand, iron bits
    among them; a robot with four hall sensors finds where it is on a floor of landmarks, of
    which one lacks a bar. Writes the session, the solution and a plot of each, and what to print.

    \b
    Examples:
      locatk demo
      locatk demo dots -o demo
      locatk demo --seed 7 --json
    """
    folder = _folder(output)
    chosen = [name for name in SYSTEMS if name in systems or not systems]
    makers = {
        "lighthouse": _lighthouse,
        "dots": _dots,
        "polaris": _polaris,
        "landmarks": _landmarks,
    }
    for name in chosen:
        for path in _files(folder, name):
            options.guard_output(path, overwrite=overwrite)
    rows = [_whole_way(folder, name, makers[name], seed, overwrite) for name in chosen]
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
                    f"{1e3 * row['mae_m']:.2g}",
                    "-" if row["paper_mae_m"] is None else f"{1e3 * row['paper_mae_m']:.2g}",
                    f"{row['solve_s']:.2f}",
                )
                for row in rows
            ],
        )
    )
    console.say(
        "error: mean distance from the truth, in the frame of the markers, the sheet, the site or "
        "the map"
    )
    for row in rows:
        for file in row["files"]:
            console.say(f"Wrote {file}")


def _folder(output: Path | None) -> Path:
    import tempfile

    if output is None:
        return Path(tempfile.mkdtemp(prefix="locatk-demo-"))
    options.make_folder(output)
    return output


def _files(folder: Path, system: str) -> list[Path]:
    """Session, solution and plot, and what is to be printed."""
    printed = {
        "dots": ["-sheet.pdf"],
        "polaris": ["-tags.pdf"],
        "landmarks": ["-pack.pdf"],
    }.get(system, [])
    return [folder / f"{system}{end}" for end in (".mcap", "-solved.mcap", ".png", *printed)]


def _whole_way(
    folder: Path,
    system: str,
    make: Callable[[list[Path], int, bool], tuple[Trajectory, ...]],
    seed: int,
    overwrite: bool,
) -> dict[str, Any]:
    from locatk.cli.systems import Request, solve_session
    from locatk.core import metrics
    from locatk.formats import solutions
    from locatk.formats.plot import plot_solution

    files = _files(folder, system)
    session, solution, picture = files[:3]
    with console.working("Simulating"):
        truths = make(files, seed, overwrite)
    with console.working("Solving"):
        solved = solve_session(session, Request())
        speed = SPEED_MPS if system == "polaris" else None
        paper = solve_session(session, Request(method="paper", speed=speed))
        solutions.write_solution(solution, solved.solution, source=session, overwrite=overwrite)

    truth = {trajectory.device: trajectory for trajectory in truths}

    def error(of: Any) -> float | None:
        found = [mine for mine in of.solution.trajectories if len(mine)]
        if not found:
            return None
        return metrics.evaluate_all([(mine, truth[mine.device]) for mine in found]).mae

    with console.working("Drawing"):
        plot_solution(picture, solved.solution, truth=truths, overwrite=overwrite)
    return {
        "system": system,
        "poses": solved.solution.poses,
        "mae_m": error(solved),
        "paper_mae_m": error(paper),
        "solve_s": solved.solve_s,
        "files": [str(path) for path in files],
    }


def _lighthouse(files: list[Path], seed: int, overwrite: bool) -> tuple[Trajectory, ...]:
    from locatk.core.lighthouse.simulate import SimulationOptions, simulate
    from locatk.formats import observations

    simulated = simulate(
        SimulationOptions(robots=2, stations=2, planar=True, duration_s=60.0, seed=seed)
    )
    observations.write_session(
        files[0],
        system="lighthouse",
        sweeps=simulated.sweeps,
        scene=simulated.scene,
        truth=simulated.truth,
        overwrite=overwrite,
    )
    return simulated.truth


def _dots(files: list[Path], seed: int, overwrite: bool) -> tuple[Trajectory, ...]:
    from math import radians

    from locatk.core.dots import simulate
    from locatk.formats import frames
    from locatk.formats.output import atomic_write
    from locatk.formats.pdf import pattern

    wanted = simulate.SimulationOptions(
        frames=200,
        rate_hz=25.0,
        speed_mps=0.25,
        tilt_rad=radians(3),
        missing=0.02,
        dust=0.01,
        jitter_m=10e-6,
        noise=6.0,
        vignette=0.3,
        seed=seed,
    )
    simulated = simulate.simulate(None, wanted)
    frames.write_session(
        files[0],
        [simulated.frames],
        simulated.manifest,
        camera=simulated.camera,
        truth=(simulated.truth,),
        overwrite=overwrite,
    )
    with atomic_write(files[3], overwrite=overwrite) as stream:
        stream.write(pattern.render(simulated.manifest))
    return (simulated.truth,)


def _polaris(files: list[Path], seed: int, overwrite: bool) -> tuple[Trajectory, ...]:
    from math import radians

    from locatk.core.polaris import cards, simulate
    from locatk.core.polaris.codec import layout_of
    from locatk.core.polaris.tag import Placed, Tags
    from locatk.formats import arrays
    from locatk.formats.output import atomic_write
    from locatk.formats.pdf import tag

    ids = (262_143, 77, 123_456)
    tags = Tags(
        codec="polaris-released",
        site={
            number: Placed(0.5 * k, 0.02 * k, radians(turn))
            for k, (number, turn) in enumerate(zip(ids, (0.0, 90.0, 200.0), strict=True))
        },
    )
    simulated = simulate.simulate(
        tags,
        simulate.SimulationOptions(
            route=ids,
            speed_mps=SPEED_MPS,
            build_angle_rad=radians(3),
            build_place_m=0.2e-3,
            build_strength=0.03,
            debris=3,
            odometry=True,
            seed=seed,
        ),
    )
    arrays.write_session(
        files[0],
        [simulated.samples],
        tags=tags,
        truth=(simulated.truth,),
        odometry=() if simulated.odometry is None else (simulated.odometry,),
        overwrite=overwrite,
    )
    drawn = cards.draw(tags, [(number, layout_of(tags, number)) for number in ids], (210.0, 297.0))
    with atomic_write(files[3], overwrite=overwrite) as stream:
        stream.write(tag.render(drawn.pages, "locatk demo"))
    return (simulated.truth,)


def _landmarks(files: list[Path], seed: int, overwrite: bool) -> tuple[Trajectory, ...]:
    from locatk.core.landmarks import simulate
    from locatk.core.landmarks.design import DesignOptions, design
    from locatk.core.landmarks.pack import pack
    from locatk.formats import halls
    from locatk.formats.output import atomic_write
    from locatk.formats.pdf import landmarks

    floor = design(DesignOptions(rows=6, columns=8, seed=seed))
    wanted = simulate.SimulationOptions(
        start=(0.3, 0.3, 0.4),
        landmarks=9,
        spins=9,
        faults=simulate.Faults(missing=(((2, 2), 1),)),
        seed=seed,
    )
    simulated = simulate.simulate(floor, wanted)
    halls.write_session(
        files[0],
        simulated.samples,
        floor=floor,
        truth=simulated.truth,
        odometry=simulated.odometry,
        overwrite=overwrite,
    )
    made = pack(floor, (210.0, 297.0), paper_name="A4")
    with atomic_write(files[3], overwrite=overwrite) as stream:
        stream.write(landmarks.render(made.pages, "locatk demo"))
    return simulated.truth
