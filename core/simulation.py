"""What all simulators share."""

from __future__ import annotations

from collections.abc import Iterable

from locatk.core.errors import InputError


def check_options(options: object, rules: Iterable[tuple[str, bool, str]]) -> None:
    """Refuse simulation options that cannot be.

    Parameters
    ----------
    options : object
        The options, whose attributes are named in the error.
    rules : iterable of (name, fits, wanted)
        Name of an attribute, whether its value fits, and what would.

    Raises
    ------
    InputError
        The first that does not fit.
    """
    for name, fits, wanted in rules:
        if not fits:
            value = getattr(options, name)
            raise InputError(f"a simulation with {name} {value!r}", hint=f"give {wanted}")
