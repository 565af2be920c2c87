"""Benchmark of Lighthouse."""
