"""Many recordings: a pure function a file, on the cores of a machine or on a cluster."""
