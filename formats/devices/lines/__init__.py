"""Devices that send lines of text."""
