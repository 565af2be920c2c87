"""``locatk live``."""
