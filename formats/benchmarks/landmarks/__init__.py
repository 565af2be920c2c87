"""Benchmark of the landmarks."""
