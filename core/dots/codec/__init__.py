"""Codecs of the dot pattern: positions to symbols and back."""

from locatk.core.dots.codec.pattern import (
    CODEC_NAMES,
    DOT_DIRECTIONS,
    MAIN_SEQUENCE,
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    SYMBOL_LETTERS,
    Codec,
    check_window,
    codec,
)

__all__ = [
    "CODEC_NAMES",
    "DOT_DIRECTIONS",
    "MAIN_SEQUENCE",
    "MAIN_SEQUENCE_LENGTH",
    "SECTION_LENGTH",
    "SYMBOL_LETTERS",
    "Codec",
    "check_window",
    "codec",
]
