"""Recordings of the DotBot group.

``recording`` reads published CSV files (``count_rows``) with the floor square and the pixel
tracks of a camera (``floor_square``); ``log`` reads logs of PyDotBot.
"""
