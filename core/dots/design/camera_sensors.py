"""Image sensors of common camera modules, from public data sheets and documentation.

Saturation and dynamic range are given only if a source states them; the others have the defaults
of :class:`~locatk.core.dots.design.camera_setup.Sensor`. Check a data sheet before buying.
"""

from __future__ import annotations

from locatk.core.dots.design.camera_setup import Sensor

SENSORS = (
    Sensor(
        "mt9v034-binned",
        (188, 120),
        24e-6,
        60.0,
        dynamic_range_db=55.0,
        source="the camera of Hostettler et al., ICRA 2016: MT9V034 binned 4 x 4",
    ),
    Sensor(
        "mt9v034",
        (752, 480),
        6e-6,
        60.0,
        dynamic_range_db=55.0,
        source="onsemi MT9V034/D (752 x 480, 6 um, 60 fps, 55 dB linear)",
    ),
    Sensor(
        "ov7251",
        (640, 480),
        3e-6,
        99.0,
        source="Luxonis documentation of sensors, OV7251 (640 x 480, 3 um, 99 fps)",
    ),
    Sensor(
        "ov9281",
        (1280, 800),
        3e-6,
        120.0,
        source="OmniVision OV9281 data sheet 1.22, 2017 (1280 x 800, 3 um, 120 fps)",
    ),
    Sensor(
        "ov9281-binned",
        (640, 400),
        6e-6,
        120.0,
        source="OmniVision OV9281 data sheet 1.22, 2017, binned 2 x 2",
    ),
    Sensor(
        "ar0144",
        (1280, 800),
        3e-6,
        60.0,
        source="onsemi AR0144CS/D (1280 x 800, 3 um, 60 fps)",
    ),
    Sensor(
        "imx296",
        (1456, 1088),
        3.45e-6,
        60.0,
        is_colour=True,
        source="Raspberry Pi Global Shutter Camera (1456 x 1088, 3.45 um, 60 fps)",
    ),
    Sensor(
        "imx219-binned",
        (1640, 1232),
        2.24e-6,
        40.0,
        shutter="rolling",
        is_colour=True,
        max_snr_db=36.0,
        dynamic_range_db=67.0,
        source="Raspberry Pi Camera Module 2 NoIR, binned 2 x 2 (1.12 um, 4.3 ke-, 36 dB, 67 dB)",
    ),
    Sensor(
        "ov7725",
        (640, 480),
        6e-6,
        60.0,
        shutter="rolling",
        is_colour=True,
        source="OmniVision OV7725 data sheet 1.1, 2007 (640 x 480, 6 um, 60 fps)",
    ),
    Sensor(
        "ov7670",
        (640, 480),
        3.6e-6,
        30.0,
        shutter="rolling",
        is_colour=True,
        source="OmniVision OV7670 data sheet 1.4, 2006 (640 x 480, 3.6 um, 30 fps)",
    ),
    Sensor(
        "ov2640",
        (1600, 1200),
        2.2e-6,
        15.0,
        shutter="rolling",
        is_colour=True,
        source="OmniVision OV2640 data sheet (1600 x 1200, 2.2 um, 15 fps)",
    ),
)
"""Sensors that ``locatk camera design`` compares."""


def sensor_named(name: str, sensors: tuple[Sensor, ...] = SENSORS) -> Sensor | None:
    """Return the sensor of a name, without regard to case; None if there is none."""
    return next((sensor for sensor in sensors if sensor.name.lower() == name.lower()), None)
