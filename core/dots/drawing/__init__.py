"""Layouts of printed sheets on the pixels of the printer."""
