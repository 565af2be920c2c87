"""Outputs of ``locatk live``: each sends estimates to one kind of receiver.

A sink is created from an address such as ``udp://host:port`` (:mod:`.registry`). The contract is in
:mod:`.interface`: a sink never delays the solver, and counts what it drops.
"""
