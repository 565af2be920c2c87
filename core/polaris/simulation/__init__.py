"""Simulated passes of a magnetometer array over tags, with their truth."""
