"""``locatk capture``."""
