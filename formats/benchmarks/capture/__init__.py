"""Benchmark of capture and recovery."""
