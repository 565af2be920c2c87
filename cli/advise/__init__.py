"""``locatk advise``: the four systems side by side for a task."""
