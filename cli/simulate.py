"""``locatk simulate``: sessions with known truth, before buying anything."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from locatk.cli import console, options, simulate_dots, simulate_landmarks, simulate_polaris

if TYPE_CHECKING:
    from locatk.core.lighthouse.receiver import Receiver


DECK = "deck"

REPORT_HZ = 10.0
"""Of a DotBot."""

EVERY_SWEEP_HZ = 120.0
"""Reports faster than rotors turn hold each sweep once."""


@click.group(short_help="Make a session with known truth, without hardware.")
def command() -> None:
    """Make a session with known truth, without hardware.

    \b
    Examples:
      locatk simulate lighthouse -o run.mcap
      locatk simulate dots -o run.mcap
      locatk simulate polaris -o run.mcap --id 262143
      locatk simulate landmarks map.toml -o run.mcap
    """


command.add_command(simulate_dots.command, "dots")
command.add_command(simulate_polaris.command, "polaris")
command.add_command(simulate_landmarks.command, "landmarks")


@command.command(short_help="Robots driving under Lighthouse stations.")
@options.output("Session to write (.mcap), with the truth in it.")
@click.option("--robots", type=click.IntRange(1), default=1, show_default=True)
@click.option("--stations", type=click.IntRange(1, 16), default=2, show_default=True)
@click.option(
    "--planar/--3d",
    "planar",
    default=True,
    show_default=True,
    help="Robots on the floor, or moved through space.",
)
@click.option(
    "--duration",
    "duration_s",
    type=click.FloatRange(min=0, min_open=True),
    default=30.0,
    show_default=True,
    metavar="SECONDS",
)
@click.option(
    "--noise-udeg",
    type=click.FloatRange(min=0),
    default=300.0,
    show_default=True,
    help="Standard deviation of an angle, in millionths of a degree. The default is the paper's "
    "jitter of the rotor; receivers at a standstill scatter by about 6600.",
)
@click.option(
    "--occlusion",
    type=click.FloatRange(0, 1, max_open=True),
    default=0.0,
    show_default=True,
    help="Share of the time in which a station is hidden from a robot.",
)
@click.option(
    "--outliers",
    type=click.FloatRange(0, 1, max_open=True),
    default=0.0,
    show_default=True,
    help="Share of sweeps that are wrong: jumps and reflections.",
)
@click.option(
    "--receiver",
    metavar="deck|FILE",
    help="Photodiodes that each robot carries (receiver.toml, or Bitcraze's Lighthouse deck), of "
    "which it reports every sweep; else it has one, and reports ten times a second.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@options.overwrite
@options.as_json
@options.verbosity
def lighthouse(
    output: Path,
    robots: int,
    stations: int,
    planar: bool,
    duration_s: float,
    noise_udeg: float,
    occlusion: float,
    outliers: float,
    receiver: str | None,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate robots that drive under Lighthouse stations into a session with truth.

    The same options and seed give the same sweeps. The session holds markers, as a user
    would measure them, but not the stations: those are for the solver to find.

    \b
    Examples:
      locatk simulate lighthouse -o run.mcap
      locatk simulate lighthouse -o swarm.mcap --robots 20 --stations 4 --duration 60
      locatk simulate lighthouse -o hard.mcap --3d --occlusion 0.2 --outliers 0.02 --seed 7
      locatk simulate lighthouse -o deck.mcap --3d --receiver deck
    """
    import math

    from locatk.core.lighthouse import simulation
    from locatk.formats import observations

    carried = None if receiver is None else _receiver(receiver)
    aside = () if receiver in (None, DECK) else (Path(str(receiver)),)
    options.guard_output(output, overwrite=overwrite, inputs=aside)
    with console.working("Simulating"):
        simulated = simulation.simulate(
            simulation.SimulationOptions(
                robots=robots,
                stations=stations,
                planar=planar,
                duration_s=duration_s,
                noise_rad=math.radians(noise_udeg * 1e-6),
                occlusion=occlusion,
                outliers=outliers,
                seed=seed,
                receiver=carried,
                report_hz=REPORT_HZ if carried is None else EVERY_SWEEP_HZ,
            )
        )
        observations.write_session(
            output,
            system="lighthouse",
            sweeps=simulated.sweeps,
            scene=simulated.scene,
            truth=simulated.truth,
            receivers={} if carried is None else dict.fromkeys(simulated.sweeps.devices, carried),
            overwrite=overwrite,
        )
    truth_poses = sum(len(trajectory) for trajectory in simulated.truth)
    console.result(f"Wrote {output}: {len(simulated.sweeps)} sweeps, {truth_poses} truth poses")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "sweeps": len(simulated.sweeps),
                "devices": list(simulated.sweeps.devices),
                "truth_poses": truth_poses,
            }
        )


def _receiver(name: str) -> Receiver:
    """The deck, or what a file says."""
    from locatk.core.lighthouse.receiver import DECK as DECKS_OWN
    from locatk.formats.receivers import read_receiver

    return DECKS_OWN if name == DECK else read_receiver(Path(name))
