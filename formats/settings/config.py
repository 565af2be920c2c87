"""Configuration file of a simulation or a task: TOML with a comment for every key.

Each simulator declares its settings once, as :class:`Setting`: key, type and range, meaning,
default, and possibly a flag. The TOML file (:meth:`SettingsConfig.dumps`,
:meth:`SettingsConfig.read`) and the options of the command line
(:mod:`locatk.cli.settings_command`) are made of that declaration.

Settings are kept as a mapping from key to value, in the units of the file, which holds only what
was set. Values of the command line override those of the file (:meth:`SettingsConfig.merge`);
:meth:`SettingsConfig.in_si` converts them to the units of the simulators.
"""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from locatk.core.errors import InputError
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.kinds import FilePath, ListOf, Number
from locatk.formats.artifacts.schema import Key, Table, header, parse_document
from locatk.formats.artifacts.toml import Inline
from locatk.formats.settings.setting import NO_DEFAULT, Requirement, Setting

FORMAT_VERSION = 1
"""Version of the configuration files of all simulators."""

COMMENT_WIDTH_CHARACTERS = 98
"""Longest line of a comment in a configuration file."""


class SettingsError(InputError):
    """Settings that contradict each other: a usage error."""

    exit_status = 2


@dataclass(frozen=True)
class SettingsConfig:
    """Settings of one simulator, or of a task.

    Attributes
    ----------
    system : str
    settings : tuple of Setting
        In the order of the file, table by table.
    defaults : object
        Options of the simulator with their defaults.
    conflicts : tuple of (keys, keys)
        None of the first keys can be set together with one of the second; false counts as not set.
    requirements : tuple of Requirement
    command : str
        Command that reads the file; by default that of the simulator.
    format : str
        Key ``format`` of the file; by default that of the simulator.
    """

    system: str
    settings: tuple[Setting, ...]
    defaults: object
    conflicts: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = ()
    requirements: tuple[Requirement, ...] = ()
    command: str = ""
    format: str = ""

    # ---- declaration

    @property
    def tables(self) -> dict[str, list[Setting]]:
        """Settings by table, in the order of the file."""
        tables: dict[str, list[Setting]] = {}
        for setting in self.settings:
            tables.setdefault(setting.table, []).append(setting)
        return tables

    def setting(self, key: str) -> Setting:
        """Return the setting of a key."""
        return next(setting for setting in self.settings if setting.key == key)

    def default(self, setting: Setting) -> Any:
        """Return the default in units of the file; None if it is None, empty or infinite."""
        if setting.default is not NO_DEFAULT:
            return setting.default
        value = self._default_si(setting)
        if value in (None, (), "") or (isinstance(value, float) and math.isinf(value)):
            return None
        return _shortest(value, setting.factor) if isinstance(setting.kind, Number) else value

    def default_text(self, setting: Setting) -> str:
        """Describe the default."""
        if setting.default_text:
            return setting.default_text
        value = self.default(setting)
        if isinstance(value, bool):
            return "true" if value else "false"
        return f"{value:g}" if isinstance(value, float) else str(value)

    def replacements(self, former_flag: str) -> list[Setting]:
        """Return the settings that replace an option of earlier versions."""
        return [setting for setting in self.settings if former_flag in setting.former_flag.split()]

    def _default_si(self, setting: Setting) -> Any:
        value: Any = self.defaults
        for name in setting.field.split(".") if setting.field else ():
            value = getattr(value, name)
        return value if setting.field else None

    # ---- file

    def dumps(self, settings: Mapping[str, Any] | None = None) -> str:
        """Return the TOML file: every key with a comment, commented out if it is not set."""
        settings = settings or {}
        lines = [
            f"# Settings of `{self.command or f'locatk simulate {self.system} --config FILE'}`.",
            "# A key after # has its default, or an example of a value. Remove the # to set it.",
            "# Options of the command line override this file.",
            *toml.dumps(header(self._format, FORMAT_VERSION)).splitlines(),
        ]
        for table, members in self.tables.items():
            lines += ["", f"[{table}]"]
            for setting in members:
                lines += ["", *self._entry(setting, settings)]
        return "\n".join(lines) + "\n"

    def _entry(self, setting: Setting, settings: Mapping[str, Any]) -> Iterator[str]:
        """Yield the comment and the key of a setting."""
        unit = f" [{setting.unit}]" if setting.unit else ""
        default = self.default(setting)
        comment = f"{setting.help}{unit}. Default: {self.default_text(setting)}."
        yield from textwrap.wrap(
            comment, COMMENT_WIDTH_CHARACTERS, initial_indent="# ", subsequent_indent="# "
        )
        is_set = setting.key in settings
        value = settings[setting.key] if is_set else setting.example if default is None else default
        text = toml.dumps({setting.name: _inline(setting.kind.to_toml(value))})
        yield from (line if is_set else f"#{line}" for line in text.splitlines())

    def read(self, path: str | os.PathLike[str]) -> dict[str, Any]:
        """Read the settings of a file; files that it names are relative to its folder.

        Raises
        ------
        MissingDataError
            There is no such file.
        ArtifactError
            It is not TOML or of another simulator, or a key is unknown or has a wrong value.
        """
        return self._parse(toml.read(path), path, Path(path).parent)

    def loads(self, text: str) -> dict[str, Any]:
        """Read the settings of TOML text like :meth:`read`, relative to the working folder."""
        file = f"<{self._format}>"
        return self._parse(toml.loads(text, file), file, Path())

    def from_tables(self, tables: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Return the settings of tables as :meth:`read` does, relative to the working folder."""
        document = header(self._format, FORMAT_VERSION) | {k: dict(v) for k, v in tables.items()}
        return self._parse(document, "settings", Path())

    @property
    def _format(self) -> str:
        return self.format or f"locatk-simulation-{self.system}"

    def _parse(
        self, data: dict[str, Any], file: str | os.PathLike[str], folder: Path
    ) -> dict[str, Any]:
        tables = parse_document(data, file, self._format, FORMAT_VERSION, self._schema)
        settings = {}
        for setting in self.settings:
            value = (tables[setting.table] or {}).get(setting.name)
            if value is not None:
                if isinstance(setting.kind, FilePath):
                    value = setting.kind.resolve(value, folder)
                elif isinstance(setting.kind, ListOf) and isinstance(setting.kind.item, FilePath):
                    value = tuple(setting.kind.item.resolve(path, folder) for path in value)
                settings[setting.key] = value
        return settings

    @property
    def _schema(self) -> Table:
        """Tables of the file; values stay in its units."""
        return Table(
            tuple(
                Key(
                    name,
                    Table(
                        tuple(
                            Key(s.name, s.kind, default=None, is_si=False, value_name=s.name)
                            for s in members
                        )
                    ),
                    default=None,
                )
                for name, members in self.tables.items()
            )
        )

    # ---- settings

    def merge(self, file: Mapping[str, Any], flags: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of a file, overridden by those of the command line.

        Settings of the file that cannot be combined with one of the command line are dropped.

        Raises
        ------
        SettingsError
            Settings contradict each other.
        """
        replaced = set(flags)
        for first, second in self.conflicts:
            for keys, others in ((first, second), (second, first)):
                if any(_is_set(flags, key) for key in keys):
                    replaced.update(others)
        for need in self.requirements:
            if need.other in flags and need.values and flags[need.other] not in need.values:
                replaced.add(need.key)
        merged = {key: value for key, value in file.items() if key not in replaced} | dict(flags)
        self._check_combinations(merged)
        return merged

    def _check_combinations(self, settings: Mapping[str, Any]) -> None:
        """Raise an error for settings that cannot be combined; those that are off do not count."""
        for first, second in self.conflicts:
            first_key = next((key for key in first if _is_set(settings, key)), None)
            second_key = next((key for key in second if _is_set(settings, key)), None)
            if first_key and second_key:
                titles = f"{self.setting(first_key).title} or {self.setting(second_key).title}"
                raise SettingsError(f"Give {titles}, not both")
        for need in self.requirements:
            if not _is_set(settings, need.key):
                continue
            needed = self.setting(need.other)
            value = settings.get(need.other, self.default(needed))
            is_met = value in need.values if need.values else value is not None
            if not is_met:
                choices = " or ".join(map(str, need.values))
                raise SettingsError(
                    f"{self.setting(need.key).title} needs {needed.title} {choices}".rstrip()
                )

    def in_si(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return settings by ``field``, or by key if they have none, in units of the simulators.

        A value that equals the default of the file gives exactly the default of the simulator.
        """
        converted = {}
        for key, value in settings.items():
            setting = self.setting(key)
            if setting.field and value == self.default(setting):
                value = self._default_si(setting)
            elif isinstance(setting.kind, Number):
                value = value * setting.factor
            converted[setting.field or key] = value
        return converted

    def files(self, settings: Mapping[str, Any]) -> list[Path]:
        """Return the files that settings name."""
        files: list[Path] = []
        for key, value in settings.items():
            kind = self.setting(key).kind
            if isinstance(kind, FilePath):
                files += [Path(value)] if value not in kind.names else []
            elif isinstance(kind, ListOf) and isinstance(kind.item, FilePath):
                files += map(Path, value)
        return files


def _is_set(settings: Mapping[str, Any], key: str) -> bool:
    return settings.get(key, False) is not False


def with_values(options: Any, values: Mapping[str, Any]) -> Any:
    """Return a copy of a dataclass with attributes replaced; dots in names separate levels."""
    direct = {name: value for name, value in values.items() if "." not in name}
    for part in dict.fromkeys(name.partition(".")[0] for name in values if "." in name):
        nested = {
            name.removeprefix(f"{part}."): value
            for name, value in values.items()
            if name.startswith(f"{part}.")
        }
        direct[part] = with_values(getattr(options, part), nested)
    return replace(options, **direct)


def _inline(value: Any) -> Any:
    """Mark the tables inside a value to be written on one line."""
    if isinstance(value, dict):
        return Inline(value)
    return [_inline(item) for item in value] if isinstance(value, list) else value


def _shortest(value: float, factor: float) -> float:
    """Return the number with the fewest digits that ``factor`` converts to ``value``."""
    for digits in range(1, 17):
        number = float(f"{value / factor:.{digits}g}")
        if math.isclose(number * factor, value, rel_tol=1e-14):
            return number
    return value / factor
