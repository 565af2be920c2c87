"""Simulated Lighthouse sessions with ground truth.

``session`` simulates a session: ``paths`` are the trajectories of the robots, ``optics`` the
sweeps that their photodiodes receive, ``faults`` the outliers among these, and ``inertia`` the
samples of their inertial measurement units.
"""

from locatk.core.lighthouse.simulation.session import (
    SimulatedSession,
    SimulationOptions,
    simulate,
)

__all__ = ["SimulatedSession", "SimulationOptions", "simulate"]
