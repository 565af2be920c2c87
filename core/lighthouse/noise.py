"""Noise of rotor angles, and the gates that separate inliers from outliers."""

from __future__ import annotations

ANGLE_SIGMA_RAD = 1.15e-4
"""Standard deviation of a rotor angle at a standstill, in radians: 2.2 LFSR steps, measured
on 4,759 moments of the published grid."""

CALIBRATION_SIGMA_RAD = 4e-4
"""What a generic calibration adds to an angle after the scene is fitted, in radians: over
simulated scenes with other units' factory calibrations, with which the covariance is as
large as the errors (0.27e-3 with four stations, 0.36e-3 with two on a floor, 0.58e-3 in
space)."""

INLIER_GATE_RAD = 0.01
"""Angle by which a plane may miss the position it helped to find, in radians: what a robot
at half a metre a second moves between the sweeps of two stations, and a third of a
demodulation error."""

INLIER_GATE_SIGMAS = 8.0
MIN_INLIER_GATE_RAD = 1.5e-3
"""The gate follows the noise of the recording at this many standard deviations, but stays
above what a generic calibration leaves unmodelled."""

MAX_MARKER_MISFIT_M = 0.02
"""Maximum rms distance of the markers from the positions that the scene assigns to them, in metres,
above which a warning is given: ten times what hand measurement and a generic calibration leave."""
