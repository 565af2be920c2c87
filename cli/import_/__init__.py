"""``locatk import``."""
