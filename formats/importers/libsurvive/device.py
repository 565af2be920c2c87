"""Photodiodes of devices, and poses and calibrations of stations, in recordings of libsurvive.

Frames, as defined in cntools/libsurvive (MIT):

* ``lighthouse_config`` gives photodiodes in the axes of the device's model ("trackref").
  ``imu`` and ``head`` are poses in them, by ``plus_x``, ``plus_z`` and ``position``
  (``solve_vive_pose`` of ``survive_default_devices.c``); older devices have
  ``trackref_from_imu`` and ``trackref_from_head`` (qx qy qz qw x y z).
* ``POSE`` is of the head, or of the imu if the option ``report-in-imu`` was set
  (``survive_default_imupose_process``): photodiodes are given in those axes here, so that
  solved poses compare with recorded ones as they are.
* Sensors of sweeps are rows of ``modelPoints``: ``channelMap`` has been applied before they
  are written (``survive_map_sensor_id``).
* A station points along -z, x right, y up; in locatk x forward, y left, z up.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.geometry import matrix_from_quaternion, rigid_inverse, se3, transform_points
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.receiver import Receiver
from locatk.formats.files import read_bytes
from locatk.formats.tables.numbers import parse_number

Array = NDArray[np.float64]

MAX_PHOTODIODES = 64
"""Most photodiodes of a device; trackers and headsets have up to 32."""

MAX_OFFSET_M = 10.0
"""Largest plausible distance of a photodiode from the origin of its device."""

MIN_VECTOR_LENGTH = 1e-6
"""Shorter vectors have no direction."""

STATION_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Axes of a station in locatk (columns: forward, left, up) in those of libsurvive (right, up,
back)."""

MAX_CONFIGURATION_BYTES = 1 << 20
"""Largest stored configuration; sixteen stations have about 15,000 bytes."""

STORED_PARAMETERS = ("phase", "tilt", "curve", "gibmag", "gibpha", "ogeemag", "ogeephase")
"""Names in the order of :data:`~locatk.core.lighthouse.calibration.PARAMETERS`."""

_BLOCK = re.compile(r'"lighthouse(\d{1,3})"\s*:\s*\{([^{}]*)\}')
_FIELD = re.compile(r'"(\w{1,32})"\s*:\s*(?:"([^"\n]{0,64})"|\[([^\[\]]{0,512})\])')


def read_receiver(config: bytes, in_imu: bool = False) -> Receiver:
    """Read the photodiodes of a device, in the axes in which its poses are recorded.

    Parameters
    ----------
    config : bytes
        The JSON of its line ``CONFIG``.
    in_imu : bool
        Poses are of the imu, not of the head.

    Raises
    ------
    FormatError
        The configuration is not JSON, or its points are invalid.
    """
    device = _json(config)
    light = device.get("lighthouse_config", device)
    if not isinstance(light, dict):
        raise FormatError("the device's lighthouse_config is not an object")
    points = _vectors(light.get("modelPoints"), "modelPoints")
    if np.abs(points).max() > MAX_OFFSET_M:
        raise FormatError("the device's modelPoints are metres away from it")
    from_device = rigid_inverse(_pose(device, "imu" if in_imu else "head"))
    normal: Array | None = None
    if light.get("modelNormals") is not None:
        normal = _vectors(light["modelNormals"], "modelNormals")
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        if normal.shape != points.shape or length.min() < MIN_VECTOR_LENGTH:
            raise FormatError("the device's modelNormals do not match its modelPoints")
        normal = (normal / length) @ from_device[:3, :3].T
    name = device.get("model_number")
    return Receiver(
        transform_points(from_device, points), normal, name if isinstance(name, str) else ""
    )


def serial_number(config: bytes) -> str:
    """Return the serial number of a device; empty if it has none."""
    try:
        name = _json(config).get("device_serial_number")
    except FormatError:
        return ""
    return name if isinstance(name, str) else ""


def _json(config: bytes) -> dict[str, object]:
    text = config.decode("utf-8", "replace")
    try:
        try:
            device = json.loads(text)
        except json.JSONDecodeError:
            # libsurvive itself writes a comma after the last element of a list.
            device = json.loads(re.sub(r",(\s{0,99}[\]}])", r"\1", text))
    except (ValueError, RecursionError):
        raise FormatError("the device's configuration is not JSON") from None
    if not isinstance(device, dict):
        raise FormatError("the device's configuration is not an object")
    return device


def _vectors(value: object, name: str) -> Array:
    """Return a list of points as (k, 3)."""
    try:
        points = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise FormatError(f"the device's {name} are not points") from None
    if points.ndim != 2 or points.shape[1] != 3 or not 0 < len(points) <= MAX_PHOTODIODES:
        raise FormatError(f"the device's {name} are not points")
    if not np.all(np.isfinite(points)):
        raise FormatError(f"the device's {name} are not finite numbers")
    return points


def _pose(device: dict[str, object], part: str) -> Array:
    """Return the pose (4, 4) of a part in the device's axes; the identity if unknown."""
    listed = device.get(f"trackref_from_{part}")
    pose = np.eye(4)
    if isinstance(listed, list) and len(listed) == 7:
        values = _numbers(listed, f"trackref_from_{part}")
        if np.linalg.norm(values[:4]) < MIN_VECTOR_LENGTH:
            raise FormatError(f"the device's trackref_from_{part} has no direction")
        pose = se3(matrix_from_quaternion(values[:4]), values[4:])
    axes = device.get(part)
    if isinstance(axes, dict) and "plus_x" in axes and "plus_z" in axes:
        x, z = _numbers(axes["plus_x"], part), _numbers(axes["plus_z"], part)
        if x.shape != (3,) or z.shape != (3,):
            raise FormatError(f"the axes of the device's {part} are not vectors")
        if np.any(x) and np.any(z):
            y = np.cross(z, x)
            if np.linalg.norm(y) < MIN_VECTOR_LENGTH:
                raise FormatError(f"the axes of the device's {part} are parallel")
            y /= np.linalg.norm(y)
            x /= np.linalg.norm(x)
            position = _numbers(axes.get("position", [0.0] * 3), part)
            if position.shape != (3,) or np.abs(position).max() > MAX_OFFSET_M:
                raise FormatError(f"the position of the device's {part} is invalid")
            pose = se3(np.stack([x, y, np.cross(x, y)], axis=1), position)
    return pose


def _numbers(value: object, name: str) -> Array:
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise FormatError(f"the device's {name} is not a row of numbers") from None
    if not np.all(np.isfinite(numbers)):
        raise FormatError(f"the device's {name} has a number that is not finite")
    return numbers


def station_rotation(quaternion_wxyz: Array) -> Array:
    """Return the rotation (3, 3) from station to world, in the axes of locatk."""
    return np.asarray(matrix_from_quaternion(np.roll(quaternion_wxyz, -1)) @ STATION_AXES)


def read_stored_calibrations(path: Path) -> dict[int, Calibration]:
    """Read the factory calibrations that libsurvive stored in its configuration.

    libsurvive writes ``config.json``, for a recording ``<recording>.json``, in a syntax of its
    own that is not JSON (``survive_config.c``). Numbers have six decimals.

    Parameters
    ----------
    path : path
        The configuration.

    Returns
    -------
    dict of int to Calibration
        By the station's serial number, for stations whose factory data had arrived.

    Raises
    ------
    MissingDataError
        The file is missing.
    FormatError
        The file is not readable, has no station, or a station has an invalid value.
    """
    path = Path(path)
    text = read_bytes(path, MAX_CONFIGURATION_BYTES).decode("utf-8", "replace")
    blocks = _BLOCK.findall(text)
    if not blocks:
        raise FormatError("not a configuration of libsurvive with a station", file=path)
    stored: dict[int, Calibration] = {}
    for number, block in blocks:
        fields = {name: text or values for name, text, values in _FIELD.findall(block)}
        if fields.get("OOTXSet", "0") == "0":
            continue
        try:
            station = int(fields["id"])
            rows = [_pair(fields[f"fcal{name}"]) for name in STORED_PARAMETERS]
        except (KeyError, ValueError, InputError) as error:
            problem = f"no {error.args[0]}" if isinstance(error, KeyError) else "a wrong value"
            raise FormatError(f"lighthouse{number} has {problem}", file=path) from None
        stored[station] = Calibration(np.array(rows).T, "factory")
    return stored


def _pair(text: str) -> tuple[float, float]:
    """Return the values of both planes."""
    values = [parse_number(part.strip().strip('"')) for part in text.split(",")]
    if len(values) != 2 or not np.all(np.isfinite(values)):
        raise ValueError(text)
    return values[0], values[1]
