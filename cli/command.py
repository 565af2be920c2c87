"""Commands whose help lists options in sections, and groups that suggest the nearest command.

::

    @click.command(cls=Command)
    @options.output("Solution to write.")
    @section("Noise", click.option("--noise-ut", ...), click.option("--dropouts", ...))
    def command(...): ...

Options outside of any section are listed first, under "Options".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

SECTIONS = "__locatk_sections__"
"""Attribute of a command's function: name of a parameter to the title of its section."""


def combine(*decorators: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return one decorator that applies several options, in the order of the help."""

    def decorate(function: Any) -> Any:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


def section(title: str, *decorators: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a decorator that adds options and lists them in a section of the help."""

    def decorate(function: Any) -> Any:
        count = len(getattr(function, "__click_params__", ()))
        function = combine(*decorators)(function)
        sections = {parameter.name: title for parameter in function.__click_params__[count:]}
        setattr(function, SECTIONS, {**sections, **getattr(function, SECTIONS, {})})
        return function

    return decorate


class Command(click.Command):
    """Command whose help lists its options in the sections given by :func:`section`."""

    def section_of(self, parameter: click.Parameter) -> str:
        """Return the title under which the help lists a parameter."""
        sections: dict[str | None, str] = getattr(self.callback, SECTIONS, {})
        return sections.get(parameter.name, "Options")

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections of options: first "Options", then in the order of declaration."""
        sections: dict[str, list[tuple[str, str]]] = {"Options": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None and not isinstance(parameter, click.Argument):
                sections.setdefault(self.section_of(parameter), []).append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)
