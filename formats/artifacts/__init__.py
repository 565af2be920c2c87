"""Artifacts: TOML files that describe infrastructure, sensors and printers."""
