"""Plots of solutions with matplotlib."""
