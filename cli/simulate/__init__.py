"""``locatk simulate``: sessions with known truth, without hardware.

The group loads a command's module when the command is called (:mod:`locatk.cli.lazy`).
"""

from __future__ import annotations

import click

from locatk.cli.lazy import LazyGroup

COMMANDS = {
    "dots": ("locatk.cli.simulate.dots", "Simulate a camera over a printed dot sheet."),
    "landmarks": (
        "locatk.cli.simulate.landmarks",
        "Simulate a robot with hall sensors over landmarks.",
    ),
    "lighthouse": (
        "locatk.cli.simulate.lighthouse",
        "Simulate robots under Lighthouse stations.",
    ),
    "polaris": ("locatk.cli.simulate.polaris", "Simulate a magnetometer array over magnetic tags."),
}
"""Name of a command to its module and short help. The module holds it as ``command``."""


@click.group(cls=LazyGroup, table=COMMANDS, short_help="Simulate a session with ground truth.")
def command() -> None:
    """Simulate a session with ground truth, without hardware.

    All settings of a simulation are in a TOML file with comments (--print-config, --config); the
    most common ones are options as well.

    \b
    Examples:
      locatk simulate lighthouse -o run.mcap
      locatk simulate dots -o run.mcap
      locatk simulate polaris -o run.mcap --id 262143
      locatk simulate landmarks map.toml -o run.mcap
      locatk simulate landmarks --print-config > sim.toml
      locatk simulate landmarks map.toml --config sim.toml -o run.mcap
    """
