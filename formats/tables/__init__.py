"""Tables of columns: CSV and similar text."""
