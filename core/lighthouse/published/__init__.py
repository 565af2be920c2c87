"""The published algorithms, as written."""
