"""The calibration to expect of a base station that has not told its own.

Real light planes are tilted by 27 degrees, not 30, and wobble by a few milliradians: over
a floor of 240 mm this is what separates 5 mm of error from 1 mm. Eleven factory
calibrations of other units are public in the recordings of
jdavidberger/libsurvive-extras-data (MIT; ``tests/*.json``); their mean is the prior, their
spread says how firmly to hold it. No unit of the scored data sets is among them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import (
    CURVE,
    GIBMAG,
    GIBPHASE,
    OGEEMAG,
    OGEEPHASE,
    PHASE,
    TILT,
    Calibration,
)

# One row a unit: phase of sweep 2 (that of sweep 1 is zero in all), then for both sweeps
# tilt, curve, gibmag, gibphase, ogeemag, ogeephase.
UNITS = np.array(
    [
        # 1083618720
        (-0.006382, -0.050262, 0.045624, 0.022507, 0.190430, -0.006107, -0.006329,
         1.605469, 1.793945, 0.206665, 0.187500, 1.362305, 2.062500),
        # 282585023
        (-0.006214, -0.047882, 0.041382, 0.057678, 0.348877, 0.002190, -0.003235,
         1.704102, 0.120850, -0.368164, -0.299072, 1.700195, 2.062500),
        # 3398739638
        (-0.006275, -0.047882, 0.047363, 0.116089, 0.193237, -0.007393, -0.005386,
         2.046875, 2.251953, 0.282715, 0.172363, 2.216797, 2.642578),
        # 2765867172
        (-0.002159, -0.049622, 0.043884, -0.067078, 0.295410, -0.003815, -0.002544,
         2.535156, 2.654297, -0.209839, -0.188232, 0.762207, 1.591797),
        # 2465522850
        (-0.003456, -0.051453, 0.046844, -0.035309, 0.346436, -0.006634, -0.006760,
         1.861328, 2.304688, 0.132935, 0.242310, 2.125000, 3.062500),
        # 3671943459
        (-0.007420, -0.047119, 0.045990, 0.154785, 0.326416, -0.004402, -0.003576,
         2.369141, 2.714844, -0.176636, -0.218994, 0.476562, 0.965332),
        # three units of one recording without serial numbers
        (-0.005741, -0.046600, 0.043671, 0.012390, 0.341309, 0.002470, 0.002228,
         1.010742, 2.107422, -0.417969, -0.391602, 1.328125, 1.465820),
        (-0.005077, -0.051788, 0.048309, 0.045410, 0.244629, -0.006950, -0.005329,
         2.328125, 2.812500, 0.252686, -0.216553, 3.074219, 0.843262),
        (-0.001843, -0.049988, 0.048096, -0.123108, -0.084839, -0.004356, -0.002129,
         2.291016, 2.222656, 0.143921, -0.077332, 2.939453, 1.486328),
        # 4261648623
        (-0.006184, -0.049011, 0.045746, 0.348633, 0.143433, -0.004772, -0.004246,
         1.912109, 2.226562, 0.113342, -0.210693, 3.093750, 0.364990),
        # 3651042988
        (-0.005894, -0.050537, 0.047974, 0.020767, 0.265137, -0.008698, -0.007442,
         1.968750, 2.410156, 0.248657, 0.330811, 2.167969, 3.070312),
    ]
)  # fmt: skip


def _mean(units: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 7) mean calibration; a magnitude and its phase are averaged as a phasor."""
    sweeps = np.zeros((2, 7))
    sweeps[1, PHASE] = units[:, 0].mean()
    sweeps[:, TILT] = units[:, 1:3].mean(axis=0)
    sweeps[:, CURVE] = units[:, 3:5].mean(axis=0)
    for magnitude, phase, column in ((GIBMAG, GIBPHASE, 5), (OGEEMAG, OGEEPHASE, 9)):
        phasors = units[:, column : column + 2] * np.exp(1j * units[:, column + 2 : column + 4])
        mean = phasors.mean(axis=0)
        sweeps[:, magnitude], sweeps[:, phase] = np.abs(mean), np.angle(mean)
    return sweeps


def _spread(units: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 2) standard deviation of (phase, tilt) over units."""
    spread = np.zeros((2, 2))
    spread[1, 0] = units[:, 0].std(ddof=1)
    spread[:, 1] = units[:, 1:3].std(axis=0, ddof=1)
    return spread


GENERIC = Calibration(_mean(UNITS), "generic")
"""Mean of the published factory calibrations."""

PHASE_TILT_SIGMA = _spread(UNITS)
"""(2, 2) spread of phase and tilt of each sweep over units, in radians; the phase of
sweep 1 is zero by definition."""

MODEL_SIGMA = 1e-3
"""What a generic calibration leaves unmodelled, in radians: the spread of gibmag over units
is 3 mrad, of which most is a constant that a station's pose absorbs."""
