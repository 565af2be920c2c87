"""First places of magnets: templates of one magnet, slid along the pass.

All lengths are in units of the height over the magnets, so that one set of templates
serves every speed and height: the pass is resampled to rows of a quarter of the height
along the way that is tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.detection.field_model import Offsets

Array = NDArray[np.float64]

ROW = 0.25
"""Rows along the track, in heights."""

REACH = 3.0
"""How far along the track a template reaches to both sides, in heights."""

ACROSS = 0.5
"""Steps across the track, in heights."""

FEW_SENSORS = 5

BESIDE = 1.5
"""How far beyond the last sensor magnets are looked for, in heights."""


@dataclass(frozen=True)
class Atom:
    """A magnet as the scan sees it: place (2,) in m, moment (2,) in A m^2, and how much of
    the squares of the samples (in units of their noise) it explains."""

    place_m: Array
    moment_am2: Array
    energy: float


def unshared(fields: Array) -> Array:
    """Fields (N, ...) without what all sensors of the bar share: the Earth's that turns with
    the robot, and its motors'. A bar of few sensors has no magnet that some do not see."""
    if len(fields) < FEW_SENSORS:
        return fields
    return fields - fields.mean(axis=0)


class Scanner:
    """Templates for an array at one height over the magnets.

    Parameters
    ----------
    sensors_m : (N, 3) ndarray
    noise_t : (N, 3) ndarray
    height_m : float
    """

    def __init__(self, sensors_m: Array, noise_t: Array, height_m: float) -> None:
        self.row_m = ROW * height_m
        half = round(REACH / ROW)
        along = np.arange(-half, half + 1) * self.row_m
        left, right = sensors_m[:, 1].max(), sensors_m[:, 1].min()
        margin = BESIDE * height_m
        count = int(np.ceil((left - right + 2 * margin) / (ACROSS * height_m))) + 1
        self.across_m = np.linspace(right - margin, left + margin, count)
        shape = (len(sensors_m), 3, len(along), count)
        offsets = Offsets.of(
            np.broadcast_to((sensors_m[:, 0, None] + along)[:, None, :, None], shape),
            (sensors_m[:, 1:2] - self.across_m)[:, None, None],
            height_m,
        )
        units = unshared(offsets.unit_fields()[..., :2] / noise_t[:, :, None, None, None])
        # (N, axis, rows, places, moment) to rows x (N, axis) x places x moment
        columns = units.transpose(2, 0, 1, 3, 4)
        self.half, self.channels = half, 3 * len(sensors_m)
        pairs = np.ascontiguousarray(columns.reshape(-1, count, 2).transpose(1, 0, 2))
        # Orthogonal for each place, so that energies are sums of squares.
        self.triangle = np.linalg.cholesky(pairs.transpose(0, 2, 1) @ pairs)
        pairs = pairs @ np.linalg.inv(self.triangle).transpose(0, 2, 1)
        self.templates = np.hstack([pairs[:, :, 0].T, pairs[:, :, 1].T]).astype(np.float32)

    def rows(self, path_m: Array, scaled: Array) -> tuple[Array, NDArray[np.float32]]:
        """The pass, resampled: places (R,) along the track and samples (R, 3 N).

        ``scaled`` (n, 3 N) are samples in units of their noise, without background.
        """
        order = np.argsort(path_m, kind="stable")
        by_sensor = scaled[order].reshape(len(order), -1, 3).swapaxes(0, 1)
        scaled = unshared(by_sensor).swapaxes(0, 1).reshape(len(order), -1)
        path = path_m[order] + 1e-9 * np.arange(len(path_m))
        count = max(int((path[-1] - path[0]) / self.row_m), 1)
        edges = path[0] + self.row_m * np.arange(count + 1)
        middle = (path[1:] + path[:-1]) / 2
        borders = np.concatenate([[path[0]], middle, [path[-1]]])
        width = np.diff(borders)[:, None]
        integral = np.vstack([np.zeros(scaled.shape[1]), np.cumsum(scaled * width, axis=0)])
        at = np.searchsorted(borders, edges, "right") - 1
        at = np.clip(at, 0, len(scaled) - 1)
        value = integral[at] + scaled[at] * (edges - borders[at])[:, None]
        return (edges[1:] + edges[:-1]) / 2, (np.diff(value, axis=0) / self.row_m).astype(
            np.float32
        )

    def correlate(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Products (R, 2, places) of the templates with the samples around each row; their
        squares are what a magnet there would explain."""
        padded = np.pad(rows, ((self.half, self.half), (0, 0)))
        size = (2 * self.half + 1) * self.channels
        windows = np.lib.stride_tricks.as_strided(
            padded, (len(rows), size), (padded.strides[0], padded.strides[1])
        )
        return (windows @ self.templates).reshape(len(rows), 2, -1)

    def atoms(
        self, path_m: Array, scaled: Array, most: int, least_energy: float, share: float = 0.02
    ) -> tuple[list[Atom], float]:
        """Magnets one after the other, the strongest first (matching pursuit).

        Returns them and the share of the samples' squares that they leave. It ends after
        ``most``, or where the next explains less than ``least_energy`` or ``share`` of
        the first.
        """
        places, rows = self.rows(path_m, scaled)
        before = float((rows.astype(float) ** 2).sum())
        found: list[Atom] = []
        floor = least_energy
        left = rows.copy()
        while len(found) < most:
            products = self.correlate(left)
            energies = products[:, 0] ** 2 + products[:, 1] ** 2
            row, place = divmod(int(np.argmax(energies)), energies.shape[1])
            energy = float(energies[row, place])
            if energy < floor:
                break
            floor = max(floor, share * energy)
            product = products[row, :, place]
            moment = np.linalg.solve(self.triangle[place].T, product)
            found.append(Atom(np.array([places[row], self.across_m[place]]), moment, energy))
            pair = self.templates[:, [place, place + len(self.across_m)]] @ product
            low, high = max(row - self.half, 0), min(row + self.half + 1, len(left))
            start = low - row + self.half
            left[low:high] -= pair.reshape(-1, self.channels)[start : start + high - low]
        after = float((left.astype(float) ** 2).sum())
        return found, after / max(before, 1e-30)
