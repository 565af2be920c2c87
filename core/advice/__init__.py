"""Comparison of the four systems for a task, before anything is bought."""
