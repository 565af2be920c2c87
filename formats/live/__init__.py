"""Live localization: ports in, estimates to sinks and into the recording."""
