"""``locatk eval``."""
