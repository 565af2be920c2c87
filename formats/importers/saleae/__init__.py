"""Captures of Saleae's logic analysers.

``recording`` imports a capture of infrared light as sweeps. ``logic2`` reads the binary files and
captures of Logic 2, ``csv_export`` the CSV exports of Logic 1 and 2, both as ``digital_lines``.
"""
