"""``locatk camera``: choose camera and lens for printed dots.

The group loads a command's module when the command is called (:mod:`locatk.cli.lazy`).
"""

from __future__ import annotations

import click

from locatk.cli.lazy import LazyGroup

COMMANDS = {
    "design": ("locatk.cli.camera.design", "Predict and measure a camera over printed dots."),
}
"""Name of a command to its module and short help. The module holds it as ``command``."""


@click.group(
    cls=LazyGroup,
    table=COMMANDS,
    short_help="Choose camera and lens for printed dots.",
)
def command() -> None:
    """Choose sensor, lens, distance and exposure for printed dots before buying them.

    `locatk calibrate camera` measures the lens of a camera that exists.

    \b
    Examples:
      locatk camera design --speed 0.3
      locatk camera design --sensor ov9281 --focal-length 3.6 --distance 20 --speed 0.3
      locatk camera design --sensor ov7251 --speed 0.3 --holder holder.pdf
    """
