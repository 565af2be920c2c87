"""Files of figures (matplotlib) whose bytes depend on nothing but what is drawn."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
from matplotlib import style
from matplotlib.figure import Figure

from locatk.core.errors import InputError
from locatk.formats.output import atomic_write, check_output

SUFFIXES = (".png", ".svg", ".pdf")
"""Formats of pictures."""

DPI = 100


def write_figure(
    path: str | os.PathLike[str], draw: Callable[[], Figure], *, overwrite: bool = False
) -> None:
    """Write the figure that ``draw`` returns; the same figure results in the same bytes.

    Raises
    ------
    InputError
        The suffix of the path is not one of :data:`SUFFIXES`.
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"{Path(path).name!r} is not the name of a picture",
            hint=f"End its name with one of {', '.join(SUFFIXES)}",
        )
    check_output(path, overwrite=overwrite)
    # The picture must depend neither on the date, nor on a random salt, nor on a matplotlibrc.
    metadata = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(suffix)
    settings = mpl.rc_context({"svg.hashsalt": "locatk", "font.size": 9})
    with style.context("default"), settings, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # It is drawn as a box.
        figure = draw()
        with atomic_write(path, overwrite=overwrite) as stream:
            figure.savefig(stream, format=suffix[1:], dpi=DPI, metadata=metadata)
