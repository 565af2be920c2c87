"""Arrays whose firmware sends bare float32: the published Polaris bar, and MagX.

A frame is x, y, z of sensor 1, 2, ... in microtesla, as little-endian float32 and nothing
else: no header, no length, no checksum. Polaris (github.com/wjk5117/Polaris) has nine
sensors, or three on the miniature car: 108 or 36 bytes. MagX (github.com/dychen24/magx) has
eight, and one more float for the battery that the firmware never sets: 100 bytes.

:mod:`.float_sync` finds where a frame starts, :mod:`.float_track` goes on from there, and
:mod:`.float_lock` tells by the values whether floats are the next frame.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from locatk.core.errors import InputError
from locatk.core.polaris import mlx90393
from locatk.formats.artifacts import tags
from locatk.formats.devices.decoder import Options, Stream
from locatk.formats.devices.float32.detection import Layout
from locatk.formats.devices.float32.tracking import FloatArrayDecoder
from locatk.formats.devices.recording import Recording

POLARIS = (Layout(9), Layout(3))
MAGX = (Layout(8, spare=1),)


class PolarisDecoder(FloatArrayDecoder):
    """Decoder of the device ``polaris-array``."""

    def __init__(self, options: Options) -> None:
        super().__init__(POLARIS)


class MagxDecoder(FloatArrayDecoder):
    """Decoder of the device ``magx-array``."""

    def __init__(self, options: Options) -> None:
        super().__init__(MAGX)


def encode_polaris(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Yield (time in ns, bytes) of the first array of a recording, a frame a sample.

    Raises
    ------
    InputError
        There is none, or it has neither nine nor three sensors.
    """
    return _encoded(recording, POLARIS, "polaris-array")


def encode_magx(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Yield (time in ns, bytes) of the first array of a recording, a frame a sample.

    Raises
    ------
    InputError
        There is none, or it has not eight sensors.
    """
    return _encoded(recording, MAGX, "magx-array")


def polaris_artifacts(stream: Stream) -> dict[str, str]:
    """``array.toml`` of the published bar: nine sensors 20 mm apart, or the three of the
    miniature car 8 mm apart, which the published firmware sets to FILTER_5."""
    if stream.sensors == 9:
        array = mlx90393.published_bar(9, 0.020, mlx90393.Settings())
    elif stream.sensors == 3:
        array = mlx90393.published_bar(3, 0.008, mlx90393.Settings(filt=5))
    else:
        return {}
    return {tags.ARRAY_FILE: tags.dumps_array(array)}


def magx_artifacts(stream: Stream) -> dict[str, str]:
    """None: MagX was published with seven layouts of eight sensors, and nothing tells which
    one it is (Codes/optimization/config.py of the release)."""
    return {}


def _encoded(
    recording: Recording, layouts: tuple[Layout, ...], name: str
) -> Iterator[tuple[int, bytes]]:
    if not recording.samples:
        raise InputError(f"no samples of magnetometers, which {name} sends")
    samples = recording.samples[0]
    fitting = [layout for layout in layouts if layout.sensors == len(samples.array)]
    if not fitting:
        wanted = " or ".join(str(layout.sensors) for layout in layouts)
        raise InputError(f"{len(samples.array)} sensors, where {name} has {wanted}")
    frames = np.zeros((len(samples), fitting[0].floats), "<f4")
    # The part's X looks to the right, Y back and Z down.
    by_part = -samples.field_t[:, :, [1, 0, 2]] * 1e6
    frames[:, : 3 * fitting[0].sensors] = by_part.reshape(len(samples), -1)
    times = samples.time_ns.tolist()
    return ((time, frame.tobytes()) for time, frame in zip(times, frames, strict=True))
