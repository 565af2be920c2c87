"""Identification of tags: from detected magnets to a tag, its id and its pose."""
