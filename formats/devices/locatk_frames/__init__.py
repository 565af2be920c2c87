"""The locatk serial protocol, which the firmware in docs/firmware speaks.

``decoder`` turns bytes into records and back. ``framing`` finds and checks the frames, ``payloads``
encodes and parses their contents.
"""
