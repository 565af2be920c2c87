"""``locatk demo``."""
