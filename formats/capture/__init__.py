"""Recording from a port: bytes in, a session out that survives what happens in a lab."""
