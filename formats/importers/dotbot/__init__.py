"""Recordings of the DotBot group."""
