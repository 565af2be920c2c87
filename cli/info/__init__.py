"""``locatk info``."""
