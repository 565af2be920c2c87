"""Localization: from decoded windows to poses of the camera."""
