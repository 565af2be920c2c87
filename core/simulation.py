"""Validation of simulation options, shared by all simulators."""

from __future__ import annotations

from collections.abc import Iterable

from locatk.core.errors import InputError


def check_options(options: object, rules: Iterable[tuple[str, bool, str]]) -> None:
    """Raise an error for the first simulation option with an impossible value.

    Parameters
    ----------
    options : object
        Its attributes are the options.
    rules : iterable of (name, is_valid, expected)
        Name of an attribute, validity of its value, and a description of the valid values.

    Raises
    ------
    InputError
        The first option that is not valid.
    """
    for name, is_valid, expected in rules:
        if not is_valid:
            value = getattr(options, name)
            raise InputError(f"a simulation with {name} {value!r}", hint=f"give {expected}")
