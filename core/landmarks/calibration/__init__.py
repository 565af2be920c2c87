"""Calibration of a floor: as-built landmarks from recordings of drives."""
