"""Codecs of tags: identifiers and layouts of magnets, and families with a minimum distance."""

from locatk.core.polaris.codec.dispatch import capacity, check_design, id_of, layout_of

__all__ = ["capacity", "check_design", "id_of", "layout_of"]
