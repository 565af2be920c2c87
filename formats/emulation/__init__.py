"""Emulation of serial devices on pseudo-terminals, with faults of the line."""
