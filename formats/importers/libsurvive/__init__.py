"""Recordings of libsurvive.

``recording`` imports one as sweeps. ``rec_file`` reads its lines into columns, ``sweeps`` converts
the timecodes of each device to times and rotor angles, ``device`` reads photodiodes and poses.
"""
