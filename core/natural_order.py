"""Natural order of names with numbers: ``robot-2`` before ``robot-10``."""

from __future__ import annotations

import re

_NUMBER = re.compile(r"(\d+)")


def natural_key(name: str) -> tuple[tuple[tuple[int, str], ...], str]:
    """Return a sort key that compares runs of digits by their value.

    Letters are compared without case. Names that differ only in case or in leading zeros have
    different keys, so that the order does not depend on the input.

    Examples
    --------
    >>> sorted(["robot-10", "robot-2"], key=natural_key)
    ['robot-2', 'robot-10']
    """
    parts = _NUMBER.split(name)
    # Texts and numbers alternate, so that each is compared with its like.
    key = tuple(
        (int(part), "") if index % 2 else (0, part.lower()) for index, part in enumerate(parts)
    )
    return key, name
