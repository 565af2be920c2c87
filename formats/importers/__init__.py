"""Recordings and trajectories in files of other programs; a module or package a format."""
