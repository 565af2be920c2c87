"""Protobuf schemas of locatk (``*.proto``) and the code generated from them.

After a change of a ``.proto`` file run ``python formats/schemas/generate.py``; with ``--check``
it tests whether the committed code is up to date.
"""
