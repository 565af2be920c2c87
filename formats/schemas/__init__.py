"""Protobuf schemas of locatk (``*.proto``) and the code generated from them.

Change a ``.proto`` file, then run ``python formats/schemas/generate.py``; with
``--check`` it only says whether the committed code is up to date.
"""
