"""Poses of localized frames in metres, in the frames of their sheets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import LocalizedFrames
from locatk.core.dots.results import DotDetection
from locatk.core.dots.sheet import Manifest


@dataclass(frozen=True)
class SheetPoses:
    """Poses of all frames: (n, 2) m, (n,) rad, (n, 3, 3); nan for frames without a sheet."""

    position: NDArray[np.float64]
    heading: NDArray[np.float64]
    covariance: NDArray[np.float64]


def sheet_poses(
    localized: LocalizedFrames, sheet: NDArray[np.intp], manifest: Manifest
) -> SheetPoses:
    """Convert poses on the grid to metres in the frames of their sheets."""
    n = len(localized)
    poses = SheetPoses(np.full((n, 2), np.nan), np.full(n, np.nan), np.full((n, 3, 3), np.nan))
    for number in np.unique(sheet[sheet >= 0]):
        is_here = sheet == number
        poses.position[is_here], poses.heading[is_here], poses.covariance[is_here] = (
            manifest.poses_in_metres(
                int(number),
                localized.grid[is_here],
                localized.heading[is_here],
                localized.covariance[is_here],
            )
        )
    return poses


def frame_detections(
    frames: Frames,
    localized: LocalizedFrames,
    sheet: NDArray[np.intp],
    poses: SheetPoses,
    manifest: Manifest,
) -> list[DotDetection]:
    """Return the frames that have a pose."""
    return [
        DotDetection(
            time_s=frames.time_ns[k] * 1e-9,
            frame=frames.names[k],
            x_m=float(poses.position[k, 0]),
            y_m=float(poses.position[k, 1]),
            heading_rad=float(poses.heading[k]),
            confidence=float(localized.confidence[k]),
            corrected_bits=int(localized.corrected[k]),
            dots=int(localized.dots[k]),
            grid_x=float(localized.grid[k, 0]),
            grid_y=float(localized.grid[k, 1]),
            sheet=manifest.sheets[sheet[k]].id,
        )
        for k in np.flatnonzero(sheet >= 0)
    ]


def spatial_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return covariances (..., 3, 3) of x, y and heading as those of poses in space (..., 6, 6)."""
    result = np.full((*covariance.shape[:-2], 6, 6), np.nan)
    plane = np.array([0, 1, 5])
    result[..., plane[:, None], plane] = covariance
    return result
