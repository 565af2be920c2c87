"""Identification of a window of the pattern: soft bits, phase voting and decoding."""
