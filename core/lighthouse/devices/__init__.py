"""Rigid devices: poses of devices with several photodiodes at known positions."""
