"""Allocation of areas of the pattern to sheets."""
