"""Drawings of tags at true size."""
