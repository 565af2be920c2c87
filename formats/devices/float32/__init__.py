"""Devices that send bare float32 values.

``decoder`` turns bytes into records. ``synchronization`` searches for the start of a frame, and
``frame_matching`` decides whether the next bytes are a frame, as there are no markers.
"""
