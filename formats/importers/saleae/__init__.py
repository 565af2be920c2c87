"""Captures of Saleae logic analysers."""
