"""Sessions to emulate a device from, where there is none yet: one of each system.

They are what the simulators give by default, over something to see.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from math import radians

from locatk.core.errors import InputError
from locatk.formats.sessions import field_samples, observations

IDS = (262_143, 77, 123_456)
"""Tags over which the bar drives."""


def simulate_session(
    system: str, path: str | os.PathLike[str], *, seed: int = 0, overwrite: bool = False
) -> None:
    """Write a session of a system, with its artifacts and its truth.

    Parameters
    ----------
    system : str
        One of :data:`SYSTEMS`.
    path : path
        The output.
    seed : int
        The same gives the same session.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InputError
        The devices of this system have no serial port.
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    if system not in SYSTEMS:
        raise InputError(
            f"no serial port on a device of {system}",
            hint="Record its camera with `locatk capture camera:VIDEO`",
        )
    SYSTEMS[system](path, seed, overwrite)


def _polaris(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """The paper's bar over three tags, from rest."""
    from locatk.core.polaris.simulation.session import SimulationOptions, simulate
    from locatk.core.polaris.tag import PlanarPose, Tags

    places = enumerate(zip(IDS, (0.0, 90.0, 200.0), strict=True))
    site = {number: PlanarPose(0.5 * k, 0.02 * k, radians(turn)) for k, (number, turn) in places}
    tags = Tags(codec="polaris-released", site=site)
    simulated = simulate(tags, SimulationOptions(route=IDS, rest_s=1.0, odometry=True, seed=seed))
    field_samples.write_magnetometers(
        path,
        [simulated.samples],
        tags=tags,
        truth=(simulated.truth,),
        odometry=(simulated.odometry,) if simulated.odometry else (),
        overwrite=overwrite,
    )


def _landmarks(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """The paper's robot on a floor of 6 x 8 landmarks, of which it visits enough to be sure
    where it is."""
    from locatk.core.landmarks.design.generation import DesignOptions, design_map
    from locatk.core.landmarks.simulation.session import SimulationOptions, simulate

    floor = design_map(DesignOptions(rows=6, columns=8, seed=seed))
    simulated = simulate(floor, SimulationOptions(landmarks=6, seed=seed))
    field_samples.write_halls(
        path,
        simulated.samples,
        floor=floor,
        truth=simulated.truth,
        odometry=simulated.odometry,
        overwrite=overwrite,
    )


def _lighthouse(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """Two robots under two stations."""
    from locatk.core.lighthouse.simulation import SimulationOptions, simulate

    simulated = simulate(SimulationOptions(robots=2, seed=seed))
    observations.write_session(
        path,
        system="lighthouse",
        sweeps=simulated.sweeps,
        scene=simulated.scene,
        truth=simulated.truth,
        overwrite=overwrite,
    )


SYSTEMS: dict[str, Callable[[str | os.PathLike[str], int, bool], None]] = {
    "polaris": _polaris,
    "landmarks": _landmarks,
    "lighthouse": _lighthouse,
}
"""Those whose devices have a serial port."""
