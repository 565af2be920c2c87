"""A Crazyflie that rests on points of the floor and is then carried through the room.

The room, the light and the writer of logs are those of the tests of the importers, which share
nothing with the package. Load this file with ``runpy.run_path``.
"""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TOOLS: dict[str, Any] = runpy.run_path(str(Path(__file__).resolve().parents[1] / "crazyflie.py"))

FLOOR_M = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
"""Origin, point on the x axis, two others."""

REST_S, MOVE_S = 3.0, 2.0


def _smooth(u: Array) -> Array:
    """From 0 to 1 without jumps of speed and acceleration."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


class FloorVisit(_TOOLS["Flight"]):  # type: ignore[misc]
    """Flight after standstills."""

    def position(self, t: Array) -> Array:
        step = REST_S + MOVE_S
        number = np.clip(t // step, 0, len(FLOOR_M) - 1).astype(int)
        following = np.minimum(number + 1, len(FLOOR_M) - 1)
        u = _smooth((t - number * step - REST_S) / MOVE_S)[:, None]
        lifted = FLOOR_M[number] + u * (FLOOR_M[following] - FLOOR_M[number])
        lifted[:, 2] += np.where(following > number, 0.3 * np.sin(np.pi * u[:, 0]) ** 2, 0.0)
        carried = super().position(t - self.start_s) + [0.3, 0.4, 0.0]
        return lifted + _smooth((t - self.start_s) / 3.0)[:, None] * (carried - lifted)

    def angles(self, t: Array) -> tuple[Array, Array, Array]:
        weight = _smooth((t - self.start_s) / 3.0)
        yaw, pitch, roll = super().angles(t - self.start_s)
        return weight * yaw, weight * pitch, weight * roll

    @property
    def start_s(self) -> float:
        """End of the standstills."""
        return len(FLOOR_M) * (REST_S + MOVE_S) - MOVE_S


def write_log(path: Path, *, seconds: float = 30.0, seed: int = 1) -> None:
    """Write the log of a micro SD card."""
    log = _TOOLS["write_flight"](FloorVisit(seconds=seconds), np.random.default_rng(seed))
    path.write_bytes(log.data())
