"""Benchmark of Polaris."""
