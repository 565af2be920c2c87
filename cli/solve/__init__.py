"""``locatk solve``."""
