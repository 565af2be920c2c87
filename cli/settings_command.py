"""Commands whose options are declared settings (:mod:`locatk.formats.settings`).

A command gets an option for each setting with a flag, an option for a TOML file with all settings
(parameter :data:`CONFIG_FILE`), and one that prints that file (:data:`PRINT_CONFIG`). Its function
receives the merged settings as ``settings``, and the files that they name, with the TOML file, as
``input_files``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from locatk.cli import console, options
from locatk.cli.command import Command
from locatk.formats.artifacts.kinds import (
    Boolean,
    FilePath,
    Integer,
    InvalidValueError,
    Kind,
    ListOf,
    Number,
    Text,
)
from locatk.formats.settings.setting import Setting

CONFIG_FILE, PRINT_CONFIG = "config_file", "print_config"
"""Parameters of the TOML file with the settings, and of the flag that prints it."""


class SettingsCommand(Command):
    """Command whose options are declared settings, grouped as in the TOML file."""

    def __init__(self, *args: Any, module: str, **more: Any) -> None:
        """``module`` holds the settings as ``CONFIG``; it is imported when they are needed."""
        super().__init__(*args, **more)
        self._module = module

    @cached_property
    def _config(self) -> Any:
        return options.load(f"{self._module}:CONFIG")

    @cached_property
    def _settings(self) -> dict[str, Setting]:
        """Settings with a flag, by the name of their parameter."""
        return {_parameter_name(s): s for s in self._config.settings if s.flag}

    @cached_property
    def _flags(self) -> list[click.Parameter]:
        return [
            _flag(name, setting, self._config.default_text(setting))
            for name, setting in self._settings.items()
        ]

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the parameters of the command, and those of the settings."""
        return [*super().get_params(ctx), *self._flags]

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the command line; name the key that replaces an option of earlier versions."""
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            settings = self._config.replacements(error.option_name)
            if not settings:
                raise
            keys = " and ".join(f"{s.name} in [{s.table}]" for s in settings)
            raise click.UsageError(
                f"{error.option_name} is a key of the --config file now: set {keys}; "
                "--print-config writes such a file",
                ctx,
            ) from None

    def invoke(self, ctx: click.Context) -> Any:
        """Merge the settings; print them, or call the function of the command with them."""
        flags = {
            self._settings[name].key: value
            for name, value in ctx.params.items()
            if name in self._settings
            and ctx.get_parameter_source(name) is not ParameterSource.DEFAULT
        }
        others = {name: v for name, v in ctx.params.items() if name not in self._settings}
        file, is_printed = others.pop(CONFIG_FILE), others.pop(PRINT_CONFIG)
        settings = self._config.merge(self._config.read(file) if file else {}, flags)
        if is_printed:
            console.write_result(self._config.dumps(settings))
            return None
        input_files = [*self._config.files(settings), *([file] if file else [])]
        ctx.params = {**others, "settings": settings, "input_files": input_files}
        return super().invoke(ctx)

    def section_of(self, parameter: click.Parameter) -> str:
        """Return the section of an option: the table of its setting in the TOML file."""
        setting = self._settings.get(parameter.name or "")
        return setting.table.capitalize() if setting else "Options"


def existing_file(ctx: click.Context, parameter: click.Parameter, value: Any) -> Any:
    """Check that the file of an option exists; a callback of click."""
    if value is not None:
        options.must_exist([Path(value)])
    return value


def _parameter_name(setting: Setting) -> str:
    """Return the name of the parameter of a setting."""
    return setting.key.replace(".", "_")


def _flag(name: str, setting: Setting, default_text: str) -> click.Option:
    """Return the option of a setting."""
    is_list = isinstance(setting.kind, ListOf)
    kind = setting.kind.item if isinstance(setting.kind, ListOf) else setting.kind
    metavar = setting.metavar or setting.unit.upper() or _METAVARS.get(type(kind))
    repeatable = " Repeatable." if is_list else ""
    help = f"{setting.help}.{repeatable}  [default: {default_text}]"
    if isinstance(kind, Boolean):
        return click.Option([setting.flag, name], default=None, help=help)
    return click.Option(
        [setting.flag, name],
        type=_parameter_type(kind, metavar or ""),
        metavar=metavar,
        multiple=is_list,
        callback=_existing_setting(kind) if isinstance(kind, FilePath) else None,
        help=help,
    )


_METAVARS: dict[type, str] = {FilePath: "FILE", Integer: "N", Number: "NUMBER"}
"""Forms of the values of flags without a unit."""


def _parameter_type(kind: Kind, metavar: str) -> click.ParamType:
    """Return click's type of a kind of value."""
    if isinstance(kind, Number):
        return _Number(kind)
    if isinstance(kind, Integer):
        return click.IntRange(kind.low, kind.high)
    if isinstance(kind, Text):
        return click.Choice(kind.choices) if kind.choices else click.STRING
    return click.STRING if isinstance(kind, FilePath) else _Form(kind, metavar)


class _Number(click.FloatRange):
    """Number within the range and the magnitudes of its kind."""

    def __init__(self, kind: Number) -> None:
        self._kind = kind
        super().__init__(
            None if math.isinf(kind.low) else kind.low,
            None if math.isinf(kind.high) else kind.high,
            min_open=kind.is_low_excluded,
            max_open=kind.is_high_excluded,
        )

    def _describe_range(self) -> str:
        """Return the range for the help, nothing if there is none."""
        return "" if self.min is None and self.max is None else super()._describe_range()

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            return number  # Command refuses it.
        try:
            return self._kind.parse(number)
        except InvalidValueError as error:
            self.fail(f"{number:g}: {error.message}.", param, ctx)


class _Form(click.ParamType):
    """Text of a fixed form, as in ``2,3:1``."""

    def __init__(self, kind: Any, form: str) -> None:
        self._kind, self.name = kind, form

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse the text; fail with the expected form."""
        try:
            return self._kind.parse_text(value) if isinstance(value, str) else value
        except ValueError:
            self.fail(f"{value!r} is not {self.name}", param, ctx)


def _existing_setting(kind: FilePath) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """Return the callback that demands that the file of a setting exists."""

    def callback(ctx: click.Context, parameter: click.Parameter, value: Any) -> Any:
        if isinstance(value, tuple):
            options.must_exist(list(map(Path, value)))
            return value
        return value if value in kind.names else existing_file(ctx, parameter, value)

    return callback
