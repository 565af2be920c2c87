"""Demodulation: edges of light to sweeps, rotors and factory data."""
