"""Causal localization: observations in the order of time in, estimates out.

Each system has a stream (``core/<system>/stream.py``) that applies the stages of its offline solver
to the newest observations and returns fixes. :mod:`.tracker` carries poses between fixes by
odometry or an IMU; :mod:`.localizer` combines both. None of them has a clock or a thread, and
memory does not grow with the length of the input.
"""
