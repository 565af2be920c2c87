"""Benchmark of light decoding."""
