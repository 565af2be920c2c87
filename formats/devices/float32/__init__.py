"""Devices that send bare float32 values."""
