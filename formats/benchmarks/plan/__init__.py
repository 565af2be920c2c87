"""Benchmarks of planning: predictions against simulations, recordings and published sums."""
