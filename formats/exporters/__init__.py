"""Exporters: poses, maps and lists in the formats of other programs."""
