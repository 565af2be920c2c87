"""Printing: sheets, tags and drawings at true size, as PDF, SVG and pixels."""
