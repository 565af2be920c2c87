"""Simulated sessions with ground truth."""
