"""Everything that crosses the border of the process: sessions, artifacts, importers."""
