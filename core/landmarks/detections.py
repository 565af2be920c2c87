"""What is told of a sighting: the detections of a solution (docs/formats.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from locatk.core.landmarks.built import laid_code
from locatk.core.landmarks.floor import HOLE, FloorMap
from locatk.core.landmarks.globalize import HALF_PI, Located
from locatk.core.landmarks.landmark import pattern, rotated
from locatk.core.landmarks.sighting import Sighting

LIKELY = 0.8
"""Probability from which on a place on the map is told."""


def detection(
    sighting: Sighting, located: Located | None, floor: FloorMap | None
) -> dict[str, Any]:
    """What one visit has shown, in the JSON form of docs/formats.md."""
    out: dict[str, Any] = {
        "time_s": sighting.time_ns * 1e-9,
        "device": sighting.device,
        "cell": None,
        "pattern": None,
        "code": None,
        "probability": 0.0,
        "x_m": None,
        "y_m": None,
        "heading_rad": None,
        "sigma_x_m": None,
        "sigma_y_m": None,
        "sigma_heading_rad": None,
        "strength": None,
        "residual_sigma": sighting.residual_sigma,
        "refused": sighting.refused,
    }
    if not sighting.hypotheses:
        return out
    quarters = 0
    best = sighting.best
    if located is not None and located.probability >= LIKELY:
        best = sighting.hypotheses[located.hypothesis]
        quarters = located.quarters
        out["cell"] = list(located.cell)
        if floor is not None:
            laid = laid_code(floor, located.cell)
            if laid == HOLE:
                out["cell"], out["refused"] = None, "off_map"
            elif laid != rotated(best.code, quarters):
                out["refused"] = "misread"
    elif floor is not None and not sighting.refused:
        out["refused"] = "not_localised"
    code = int(rotated(best.code, quarters))
    turn = quarters * HALF_PI
    c, s = np.cos(turn), np.sin(turn)
    x, y, heading = best.pose
    sigma = np.sqrt(np.diag(best.covariance))
    across = np.abs([[c, -s], [s, c]]) @ sigma[:2]
    same = sum(h.probability for h in sighting.hypotheses if h.code == best.code)
    out |= {
        "pattern": pattern(code),
        "code": code,
        "probability": same,
        "x_m": float(c * x - s * y),
        "y_m": float(s * x + c * y),
        "heading_rad": float(np.remainder(heading + turn + np.pi, 2 * np.pi) - np.pi),
        "sigma_x_m": float(across[0]),
        "sigma_y_m": float(across[1]),
        "sigma_heading_rad": float(sigma[2]),
        "strength": [float(v) for v in np.roll(best.strength, quarters)],
    }
    return out
