"""Settings of simulations and tasks: declared once, for TOML files and the command line."""
