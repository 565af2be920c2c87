"""Simulated robots on a floor of landmarks, with their truth."""
