"""Devices that send lines of text.

``decoder`` turns bytes into records; ``blocks`` reads many similar lines at once, ``text`` one
line, ``columns`` interprets the names of its columns. ``encoder`` writes a recording as lines.
"""
