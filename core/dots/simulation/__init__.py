"""Simulated frames of a camera over printed dots, with their truth."""
