"""Declaration of the settings of a simulation or a task: keys, kinds, meanings, defaults and flags.

The kinds of values are those of all TOML files (:mod:`locatk.formats.artifacts.kinds`). A kind is
parsed from TOML and, if the setting has a flag, from the command line. Values stay in the units of
the file.

This module imports the standard library and the kinds only, so that commands that use it start
fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from locatk.formats.artifacts.kinds import NO_UNIT, UNITS, Kind, Number, Unit, unit_ending

NO_DEFAULT: Any = object()
"""Marks a setting whose default is that of an attribute of the simulator's options."""


@dataclass(frozen=True)
class Setting:
    """One option of a simulation or a task.

    Attributes
    ----------
    key : str
        Table and key in the file, as in ``"robot.speed_mps"``; its ending is the unit.
    kind : Kind
        Type and range.
    help : str
        Meaning, as a sentence without unit and default.
    field : str
        Attribute of the simulator's options, with dots for nested ones, of which the default is
        taken. Empty for a setting that the module of the system converts.
    flag : str
        Option of the command line, as in ``"--speed"``; empty if there is none.
    former_flag : str
        Option of earlier versions that this key replaces.
    default : value
        Default in units of the file, if it is not that of the attribute ``field``.
    default_text : str
        Description of a default that is not a value, as in "the clearance of the tag".
    example : value
        Shown in the file if there is no default value; in units of the file.
    metavar : str
        Form of the value of the flag, if it is not that of the unit or the kind.
    """

    key: str
    kind: Kind
    help: str
    field: str = ""
    flag: str = ""
    former_flag: str = ""
    default: Any = NO_DEFAULT
    default_text: str = ""
    example: Any = None
    metavar: str = ""

    @property
    def table(self) -> str:
        return self.key.partition(".")[0]

    @property
    def name(self) -> str:
        """Key inside its table."""
        return self.key.partition(".")[2]

    @property
    def title(self) -> str:
        """Name for messages: the flag, or the key with its table."""
        return self.flag.split("/")[0] or f"{self.name} of [{self.table}]"

    @property
    def unit(self) -> str:
        """Symbol of the unit, empty if there is none."""
        return self._unit.symbol

    @property
    def factor(self) -> float:
        """Factor from the unit of the file to that of the simulators."""
        return float(self._unit.factor)

    @property
    def _unit(self) -> Unit:
        is_number = isinstance(self.kind, Number)
        return UNITS.get(unit_ending(self.name), NO_UNIT) if is_number else NO_UNIT


@dataclass(frozen=True)
class Requirement:
    """A setting that is valid only with certain values of another one (none: any value)."""

    key: str
    other: str
    values: tuple[Any, ...] = ()
