"""Benchmark of the dots."""
