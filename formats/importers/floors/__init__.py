"""Landmark maps and sites of tags in files of other programs: tables, LIF and DXF."""
