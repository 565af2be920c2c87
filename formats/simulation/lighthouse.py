"""Settings of ``locatk simulate lighthouse``."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.simulation import SimulationOptions, simulate
from locatk.formats.artifacts.kinds import (
    FRACTION_BELOW_1,
    NOT_NEGATIVE,
    POSITIVE,
    Boolean,
    FilePath,
    Integer,
    Number,
)
from locatk.formats.artifacts.receiver import read_receiver
from locatk.formats.artifacts.scene import read_scene
from locatk.formats.sessions import observations
from locatk.formats.settings.config import SettingsConfig
from locatk.formats.settings.setting import Setting

DECK_NAME = "deck"
"""Name of Bitcraze's Lighthouse deck as a receiver."""

DOTBOT_REPORT_HZ = 10.0
"""Rate at which a DotBot reports [Hz]."""

EVERY_SWEEP_HZ = 120.0
"""Rate of reports at which each sweep is reported once [Hz]: rotors rotate at 48 to 54 Hz."""

NOISE_UDEG = 300.0
"""Jitter of the rotor (paper IV.A) [microdegrees]."""

CONFIG = SettingsConfig(
    "lighthouse",
    (
        Setting("robots.count", Integer(1), "Number of robots", "robots", "--robots"),
        Setting(
            "robots.planar",
            Boolean(),
            "Robots drive on the floor; otherwise they are moved through space, or fly",
            "planar",
            "--planar/--3d",
        ),
        Setting("robots.duration_s", POSITIVE, "Duration", "duration_s", "--duration"),
        Setting(
            "robots.receiver",
            FilePath((DECK_NAME,)),
            "Photodiodes of each robot, which reports every sweep: a receiver.toml, or deck for "
            "Bitcraze's Lighthouse deck",
            flag="--receiver",
            default=None,
            default_text="one photodiode, which reports ten times a second",
            example=DECK_NAME,
            metavar="deck|FILE",
        ),
        Setting(
            "robots.flying",
            Boolean(),
            "Robots are quadrotors with an IMU that take off, fly through space and land",
            "flying",
            "--flight/--no-flight",
        ),
        Setting(
            "robots.speed_mps",
            POSITIVE,
            "Largest speed of flights, without take-off and landing, and of robots in a room",
            "speed_mps",
        ),
        Setting("robots.imu_hz", NOT_NEGATIVE, "Rate of the IMU of flights; 0: none", "imu_hz"),
        Setting("stations.count", Integer(1, 16), "Number of stations", "stations", "--stations"),
        Setting(
            "stations.artifact",
            FilePath(),
            "Room of `locatk room design` (room.toml): its stations, mounted by hand; robots drive "
            "in its working area, and walls, obstacles and robots stop light",
            flag="--artifact",
            default=None,
            default_text="a floor of 2 m without obstacles",
            example="room.toml",
        ),
        Setting(
            "stations.factory_data",
            Boolean(),
            "The session contains the factory calibrations of the stations",
            "factory_data",
        ),
        Setting(
            "errors.noise_udeg",
            NOT_NEGATIVE,
            "Standard deviation of a rotor angle. The default is the paper's jitter of the rotor; "
            "receivers at rest scatter by about 6600",
            flag="--noise-udeg",
            default=NOISE_UDEG,
        ),
        Setting(
            "errors.occlusion_fraction",
            FRACTION_BELOW_1,
            "Fraction of the time in which a station is hidden from a robot",
            "occlusion",
            "--occlusion",
        ),
        Setting(
            "errors.outlier_fraction",
            FRACTION_BELOW_1,
            "Fraction of the sweeps that are wrong: demodulation errors, reflections, exchanged "
            "stations",
            "outliers",
            "--outliers",
        ),
        Setting(
            "errors.reflection_fraction",
            FRACTION_BELOW_1,
            "Fraction of the time in which a robot receives a station by reflection only",
            "reflections",
        ),
        Setting(
            "errors.calibration_deg",
            NOT_NEGATIVE,
            "Standard deviation of tilts and phases of the light planes from the factory "
            "calibration; real ones are up to 0.06 and 0.15 degrees off",
            "calibration_error_rad",
        ),
        Setting(
            "errors.station_turn_deg",
            Number(),
            "Angle by which the last station is turned in the middle of the session",
            "station_turn_rad",
        ),
        Setting("random.seed", Integer(0), "Seed of all random numbers", "seed", "--seed"),
    ),
    SimulationOptions(),
    conflicts=(
        (("robots.flying",), ("robots.planar",)),
        (("stations.artifact",), ("robots.flying", "robots.planar", "stations.count")),
    ),
)
"""Settings of the command."""


def simulation_options(settings: Mapping[str, Any]) -> SimulationOptions:
    """Return the options of a simulation.

    Raises
    ------
    MissingDataError, ArtifactError
        The file of the receiver or of the room is missing or invalid.
    InputError
        A value is out of its range.
    """
    values = CONFIG.in_si(settings)
    noise_udeg = values.pop("errors.noise_udeg", NOISE_UDEG)
    receiver = _read_receiver(values.pop("robots.receiver", None))
    artifact = values.pop("stations.artifact", None)
    values.setdefault("planar", not values.get("flying", False))
    if artifact is not None:
        values["room"] = read_scene(Path(artifact))
    return SimulationOptions(
        **values,
        noise_rad=math.radians(noise_udeg * 1e-6),
        receiver=receiver,
        report_hz=DOTBOT_REPORT_HZ if receiver is None else EVERY_SWEEP_HZ,
    )


def _read_receiver(name: str | None) -> Receiver | None:
    """Return the deck, or the receiver of a file."""
    if name is None:
        return None
    return DECK if name == DECK_NAME else read_receiver(Path(name))


def write_simulation(
    output: str | os.PathLike[str], settings: Mapping[str, Any], *, overwrite: bool = False
) -> dict[str, Any]:
    """Simulate robots under stations, and write the session; return the summary for ``--json``.

    Raises
    ------
    LocatkError
        A file is missing or invalid, or the settings cannot be simulated.
    """
    options = simulation_options(settings)
    simulated = simulate(options)
    sweeps, receiver = simulated.sweeps, options.receiver
    observations.write_session(
        output,
        system="lighthouse",
        sweeps=sweeps,
        scene=simulated.scene,
        truth=simulated.truth,
        imu=simulated.imu,
        true_scene=simulated.true_scene if options.room is not None else None,
        receivers={} if receiver is None else dict.fromkeys(sweeps.devices, receiver),
        overwrite=overwrite,
    )
    return {
        "sweeps": len(sweeps),
        "devices": list(sweeps.devices),
        "truth_poses": sum(len(trajectory) for trajectory in simulated.truth),
    }
