"""Recordings of libsurvive."""
