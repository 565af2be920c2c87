"""Calibration of cameras and printers from frames and scans of the pattern."""
