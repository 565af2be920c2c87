"""Noise of rotor angles, and the gates that separate inliers from outliers.

The figures marked (grid) were measured on the 3D grid recording published with the paper
(DotBots/alvarado23lighthouse, twoLH-3D_scene, BSD-3-Clause): 4,759 epochs of two base
stations at 140 points of a regular 40 mm grid, 25 to 100 epochs at rest at each point.
"""

from __future__ import annotations

ANGLE_SIGMA_RAD = 1.15e-4
"""Standard deviation of the rotor angle of one sweep at rest [rad] (grid): 2.2 LFSR steps of
52 microradians."""

CALIBRATION_SIGMA_RAD = 4e-4
"""Standard deviation of the angle error that a generic calibration leaves after the scene was
fitted with it [rad].

Measured on simulated scenes whose stations had the factory calibrations of other units: with
this value the estimated covariance agrees with the position errors. The errors themselves
were 0.27e-3 with four stations, 0.36e-3 with two stations above a floor and 0.58e-3 with two
stations and points in space."""

INLIER_GATE_RAD = 0.01
"""Largest residual of a light plane at the position estimated from it and others, of a sweep
that is still an inlier [rad]. A robot at 0.5 m/s causes about this much between the sweeps of
two unsynchronised stations. Demodulation errors are more than three times larger (paper IV.A:
above 2 degrees)."""

INLIER_GATE_SIGMAS = 8.0
"""Inlier gate in standard deviations of the recording's own residuals, limited to the range from
:data:`MIN_INLIER_GATE_RAD` to :data:`INLIER_GATE_RAD`. The gate is wide on purpose: it has to
reject errors that no noise explains (2 degrees are 300 times :data:`ANGLE_SIGMA_RAD`) and must
not cut off the tails of the noise, which would bias the covariance."""

MIN_INLIER_GATE_RAD = 1.5e-3
"""Smallest inlier gate [rad]: residuals up to this size are explained by what a generic
calibration leaves unmodelled (see :data:`~locatk.core.lighthouse.calibration.MODEL_SIGMA_RAD`),
also in a recording with little noise."""

UNREACHABLE_RESIDUAL_SIGMAS = 1e3
"""Residual of an observed angle, in standard deviations, in a state in which no light plane meets
the photodiode. It has no derivative; its cost rejects a step to such a state."""
