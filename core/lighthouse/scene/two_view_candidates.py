"""Rigs of two stations that a homography or an epipolar matrix allows, to start from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.scene import two_view as twoview
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState

Array = NDArray[np.float64]


def on_plane(a: Array, b: Array, pair: tuple[Calibration, ...]) -> list[BundleState]:
    """Rigs with the plane at z = 0 in which all points lie before both stations."""
    rigs = []
    for rotation, translation, normal in twoview.split_homography(twoview.fit_homography(a, b)):
        depth = a @ normal
        local = a / depth[:, None]
        ahead = (depth > 0) & ((local @ rotation.T + translation)[:, 0] > 0)
        if np.mean(ahead) < 0.9:
            continue
        height = 1.0 / np.linalg.norm(normal)
        up = -normal * height
        forward = np.eye(3)[0] - up[0] * up
        forward = forward / np.linalg.norm(forward)
        level = np.stack([forward, np.cross(up, forward), up])
        first = np.array([0.0, 0.0, height])
        second = first - level @ rotation.T @ translation
        if second[2] <= 0:  # on the other side of the floor
            continue
        points = local @ level.T + first
        points[:, 2] = 0.0
        rigs.append(
            BundleState(
                np.stack([first, second]), np.stack([level, level @ rotation.T]), pair, points
            )
        )
    return rigs


def in_space(a: Array, b: Array, pair: tuple[Calibration, ...]) -> list[BundleState]:
    """Rigs in the first station's axes in which most points lie before both stations."""
    motions = twoview.split_essential(twoview.fit_epipolar(a, b))
    # Few places in a narrow field make the essential matrix loose; the plane through them
    # is then the better start.
    for rotation, translation, _ in twoview.split_homography(twoview.fit_homography(a, b)):
        motions.append((rotation, translation / np.linalg.norm(translation)))
    motions += twoview.upright_motions(a, b)
    rigs = []
    for rotation, translation in motions:
        depth, other = twoview.triangulate(a, b, rotation, translation)
        ahead = (depth > 0) & (other > 0) & (depth < 100)
        if np.mean(ahead) < 0.7:
            continue
        depth = np.where(ahead, depth, np.median(depth[ahead]))
        rigs.append(
            BundleState(
                np.stack([np.zeros(3), -rotation.T @ translation]),
                np.stack([np.eye(3), rotation.T]),
                pair,
                a * depth[:, None],
            )
        )
    return rigs
