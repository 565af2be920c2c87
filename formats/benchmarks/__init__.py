"""Benchmarks: accuracy and speed beside targets and peers, a module or package a system."""
