"""``locatk array``, ``locatk halls`` and ``locatk receiver``: layouts of a robot's sensors."""
