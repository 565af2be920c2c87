"""Trajectories in continuous time: every sweep at its own time."""
