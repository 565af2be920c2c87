"""Pure computation on numpy arrays: no files, no terminal, no clock."""
