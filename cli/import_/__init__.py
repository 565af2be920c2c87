"""``locatk import``: the command, and the options and results of each system."""
