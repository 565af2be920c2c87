"""Localization on the map: visited cells, smoothing, and the trajectory of the robot."""
