"""Drawings for the installation of Lighthouse stations."""
