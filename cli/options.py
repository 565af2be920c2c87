"""Options that several commands share: one spelling and one meaning everywhere."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from locatk.cli import console
from locatk.core.errors import MissingDataError, OutputExistsError

F = TypeVar("F", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)


def _existing(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
    """Callback: every path given must be there."""
    must_exist(value if isinstance(value, tuple) else (value,))
    return value


def must_exist(paths: Sequence[Path | None]) -> None:
    """Refuse paths that are not there.

    Raises
    ------
    MissingDataError
    """
    for path in paths:
        if path is not None and not path.exists():
            raise MissingDataError(
                "No such file or folder", file=path, hint="Check the spelling of the path"
            )


def input_argument(name: str, *, many: bool = False) -> Callable[[F], F]:
    """Argument that names one file, or one or more, which must be there."""
    return click.argument(
        name, type=PATH, nargs=-1 if many else 1, required=True, callback=_existing
    )


def input_option(*names: str, help: str, many: bool = False, **more: Any) -> Callable[[F], F]:
    """Option that names a file (repeatable where ``many``) which must be there."""
    return click.option(*names, type=PATH, multiple=many, callback=_existing, help=help, **more)


sessions = input_argument("sessions", many=True)


def output(help: str, *, required: bool = True) -> Callable[[F], F]:
    """``-o/--output``."""
    return click.option("-o", "--output", type=PATH, required=required, help=help)


overwrite = click.option("--overwrite", is_flag=True, help="Replace the output if it is there.")


def _json(ctx: click.Context, param: click.Parameter, value: bool) -> bool:
    console.set_json(value)
    return value


def json_flag(what: str) -> Callable[[F], F]:
    """`--json` of a command that says ``what`` on stdout."""
    told = f"{what} on stdout, and nothing else there."
    return click.option("--json", "as_json", is_flag=True, help=told, callback=_json)


as_json = json_flag("One JSON object")

method = click.option(
    "--method",
    type=click.Choice(("bundle", "field", "joint", "lattice", "paper")),
    default=None,
    help="Algorithm: `paper` is the published one as written; the better one is `bundle` of "
    "lighthouse, `joint` of polaris, `lattice` of dots, `field` of landmarks.  "
    "[default: the system's better one]",
)

artifact = input_option(
    "--artifact",
    help="Solved artifact (scene, tag, sheet, map) to use instead of the session's.",
)


def number(*names: str, default: Any, help: str, **more: Any) -> Callable[[Any], Any]:
    """An option with a default, of the default's type where none is given."""
    more.setdefault("type", type(default))
    return click.option(*names, default=default, show_default=True, help=help, **more)


def verbosity(command: F) -> F:
    """``-q/--quiet`` and ``-v/--verbose``; they act by themselves."""

    def callback(level: int) -> Callable[[click.Context, click.Parameter, bool], None]:
        def act(ctx: click.Context, param: click.Parameter, value: bool) -> None:
            if value:
                console.set_verbosity(level)

        return act

    for short, name, level, text in (
        ("-v", "--verbose", 1, "Say more, and show tracebacks."),
        ("-q", "--quiet", -1, "Say nothing but results and errors."),
    ):
        command = click.option(
            short,
            name,
            is_flag=True,
            expose_value=False,
            is_eager=True,
            callback=callback(level),
            help=text,
        )(command)
    return command


def guard_output(path: Path, *, overwrite: bool, inputs: Sequence[Path] = ()) -> None:
    """Refuse an output that cannot or must not be written, before the work starts.

    Raises
    ------
    OutputExistsError
        Where ``path`` is one of ``inputs`` (even with ``--overwrite``), is there and
        ``overwrite`` is False, or is no file.
    MissingDataError
        Where its folder is not there.
    """
    from locatk.formats.output import check_output

    if path.exists() and any(path.samefile(item) for item in inputs if item.exists()):
        raise OutputExistsError(
            "the output is one of the inputs", file=path, hint="Choose another -o"
        )
    check_output(path, overwrite=overwrite)


def make_folder(path: Path) -> None:
    """Make the folder for several outputs; it may be there.

    Raises
    ------
    OutputExistsError
        Where ``path`` is a file.
    """
    if path.exists() and not path.is_dir():
        raise OutputExistsError(
            "there are several outputs, and -o is a file", file=path, hint="Name a folder with -o"
        )
    path.mkdir(parents=True, exist_ok=True)


def load(target: str) -> Any:
    """What ``"package.module:name"`` points to, imported now."""
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)
