"""Working time of installations: minutes for each piece of work."""

from __future__ import annotations

from collections.abc import Mapping

from locatk.core.advice.answer import WorkStep

WORK_MINUTES = {
    "mount and aim a station": 30.0,
    "measure a marker": 5.0,
    "print a sheet": 5.0,
    "lay a sheet": 10.0,
    "make a tag": 10.0,
    "place a tag": 5.0,
    "survey a tag": 2.0,
    "mark a landmark": 2.0,
    "lay a bar magnet": 1.0,
    "mill a pocket": 3.0,
    "equip a robot": 60.0,
    "calibrate and check": 60.0,
}
"""Minutes for one piece of each work. These are assumptions: no paper states times. The minutes of
``prices.toml`` replace them."""

ASSUMED = "assumption; edit [[work]] of prices.toml"
"""Source of :data:`WORK_MINUTES`."""


def work_steps(
    counts: Mapping[str, float], minutes: Mapping[str, float] | None = None
) -> tuple[WorkStep, ...]:
    """Return the steps of an installation, from the number of pieces of each work.

    Parameters
    ----------
    counts : mapping
        From names in :data:`WORK_MINUTES` to numbers of pieces; those of 0 are left out.
    minutes : mapping, optional
        Minutes of the user, by the same names.
    """
    given = minutes or {}
    return tuple(
        WorkStep(
            name,
            count,
            given.get(name, WORK_MINUTES[name]),
            "prices.toml" if name in given else ASSUMED,
        )
        for name, count in counts.items()
        if count
    )
