"""Devices that are not there: their bytes on a pseudo-terminal, with faults on demand."""
