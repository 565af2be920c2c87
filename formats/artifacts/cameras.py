"""Image sensors to choose from, ``cameras.toml``, which users extend.

It is a table of products for ``locatk camera design``. The calibration of one camera is another
artifact, ``camera.toml`` (:data:`locatk.formats.artifacts.sheets.CAMERA`).
"""

from __future__ import annotations

import os

from locatk.core.dots.design.camera_sensors import SENSORS
from locatk.core.dots.design.camera_setup import Sensor
from locatk.core.errors import InputError
from locatk.formats.artifacts.kinds import Boolean, Integer, InvalidValueError, Number, Row, Text
from locatk.formats.artifacts.schema import Artifact, Key, Table, Tables, Values, refuse_repeated

MAX_SIDE_PX = 65_535

Sensors = tuple[Sensor, ...]
"""Sensors of a file."""


def _sensor_of(values: Values) -> Sensor:
    try:
        return Sensor(**values)
    except InputError as error:
        raise InvalidValueError(error.message, "", error.hint) from None


def _sensors_of(values: Values) -> Sensors:
    sensors: Sensors = values["sensors"]
    refuse_repeated((sensor.name.lower() for sensor in sensors), "sensors", "name")
    return sensors


CAMERAS: Artifact[Sensors] = Artifact(
    "cameras.toml",
    "locatk-camera-table",
    Table(
        (
            Key(
                "sensors",
                Tables(
                    Table(
                        (
                            Key("name", Text(is_blank_allowed=False), "name for `--sensor`"),
                            Key("size_px", Row(Integer(1, MAX_SIDE_PX), 2), "width and height"),
                            Key(
                                "pixel_um",
                                Number(0.1, 100.0),
                                "width of a pixel; of a binned mode, of the binned pixel",
                            ),
                            Key(
                                "frame_rate_hz",
                                Number(0.0, 1e5, is_low_excluded=True),
                                "largest frame rate at this size",
                                value_name="max_fps",
                            ),
                            Key("shutter", Text(("global", "rolling")), "shutter"),
                            Key(
                                "colour",
                                Boolean(),
                                "whether the pixels have colour filters",
                                False,
                                value_name="is_colour",
                            ),
                            Key(
                                "max_snr_db",
                                Number(0.0, 80.0, is_low_excluded=True),
                                "signal to noise ratio at saturation, in dB: 10 log10 of the full "
                                "well in electrons",
                                38.0,
                            ),
                            Key(
                                "dynamic_range_db",
                                Number(0.0, 80.0, is_low_excluded=True),
                                "20 log10 of the full well over the read noise",
                                60.0,
                            ),
                            Key(
                                "min_exposure_ms",
                                Number(0.0, 1e4, is_low_excluded=True),
                                "shortest exposure",
                                20e-6,
                            ),
                            Key("source", Text(), "data sheet", ""),
                        ),
                        _sensor_of,
                        vars,
                    ),
                    min_count=1,
                ),
            ),
        ),
        _sensors_of,
        lambda sensors: {"sensors": sensors},
    ),
    comment="Sensors that locatk camera design compares: add those that you can buy.",
)
"""Sensors as a file."""


def cameras_template() -> str:
    """Return the text of a file with the sensors that are known to locatk."""
    return CAMERAS.dumps(SENSORS)


def read_cameras(path: str | os.PathLike[str] | None) -> Sensors:
    """Read a file of sensors; return those that are known to locatk if there is none.

    Raises
    ------
    MissingDataError, ArtifactError
        See :meth:`locatk.formats.artifacts.schema.Artifact.read`.
    """
    return SENSORS if path is None else CAMERAS.read(path)
