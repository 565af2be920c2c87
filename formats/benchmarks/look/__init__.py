"""Benchmark of evaluation, reports and the demo."""
