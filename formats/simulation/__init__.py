"""Configuration files of the simulators.

``settings`` are the declarations of keys; ``config`` reads and writes the TOML file of any
simulator. ``lighthouse``, ``dots``, ``polaris`` and ``landmarks`` declare the settings of each and
turn them into the options of its simulation.
"""
