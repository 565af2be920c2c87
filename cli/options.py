"""Options that several commands share, with one spelling and one meaning."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from locatk.cli import console
from locatk.core.errors import MissingDataError, OutputExistsError
from locatk.core.printable import is_one_line

F = TypeVar("F", bound=Callable[..., Any])


class _OneLinePath(click.Path):
    """Path without line ends: results name files, and a program reads them by line."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; fail if it has a line end."""
        path = super().convert(value, param, ctx)
        if not is_one_line(str(path)):
            self.fail(f"{str(path)!r} has a line end in its name: rename the file.", param, ctx)
        return path


PATH = _OneLinePath(path_type=Path)


class PositiveNumber(click.FloatRange):
    """Number above 0, within limits that only mistakes exceed."""

    def __init__(self, least: float, most: float) -> None:
        super().__init__(0, min_open=True)
        self.least, self.most = least, most

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number."""
        number: float = super().convert(value, param, ctx)
        if not self.least <= number <= self.most:
            self.fail(f"{number:g} is not from {self.least:g} to {self.most:g}.", param, ctx)
        return number

    def _describe_range(self) -> str:
        """Return the range for the help, without a limit that nobody comes near."""
        return "x>0" if self.most >= MIN_HIDDEN_LIMIT else f"0<x<={self.most:g}"


MIN_HIDDEN_LIMIT = 1e5
"""Smallest upper limit of a number that the help does not show."""

POSITIVE = PositiveNumber(1e-9, 1e9)
"""Positive numbers; the squares and ratios of much larger or smaller ones overflow."""


def _existing(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
    """Check that every given path exists."""
    must_exist(value if isinstance(value, tuple) else (value,))
    return value


def existing_poses(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """Check that the file of a path, which can be `FILE#NAME`, exists."""
    from locatk.formats.files import split_selection

    if value is not None:
        must_exist([split_selection(value)[0]])
    return value


def must_exist(paths: Sequence[Path | None]) -> None:
    """Raise MissingDataError if a path does not exist."""
    for path in paths:
        if path is not None and not path.exists():
            raise MissingDataError(
                "No such file or folder", file=path, hint="Check the spelling of the path"
            )


def input_argument(name: str, *, many: bool = False) -> Callable[[F], F]:
    """Return an argument that names an existing file, or one or more with ``many``."""
    return click.argument(
        name, type=PATH, nargs=-1 if many else 1, required=True, callback=_existing
    )


def input_option(*names: str, help: str, many: bool = False, **more: Any) -> Callable[[F], F]:
    """Return an option that names an existing file; repeatable with ``many``."""
    more.setdefault("metavar", "FILE")
    more.setdefault("callback", _existing)
    return click.option(*names, type=PATH, multiple=many, help=help, **more)


sessions = input_argument("sessions", many=True)


def check_ending(path: Path, endings: Sequence[str]) -> None:
    """Refuse the name of an output with another ending than those of its format.

    A name without ending is accepted.

    Raises
    ------
    UsageError
    """
    if path.suffix and path.suffix.lower() not in endings:
        raise click.UsageError(
            f"{path.name!r} ends in {path.suffix!r}; end it in {' or '.join(endings)}."
        )


def choose_format(path: Path, given: str | None, endings: Mapping[str, Sequence[str]]) -> str:
    """Return the format ``given``, which must fit the ending of a file, or that of the ending.

    Parameters
    ----------
    path : Path
    given : str or None
        By ``--format``.
    endings : mapping of str to sequence of str
        Endings of the names of each format, in lower case.

    Raises
    ------
    UsageError
        The ending is unknown, or is not of the format ``given``.
    """
    if given is not None:
        check_ending(path, endings[given])
        return given
    for name, candidates in endings.items():
        if path.suffix.lower() in candidates:
            return name
    known = ", ".join(ending for candidates in endings.values() for ending in candidates)
    raise click.UsageError(f"The ending of {path.name!r} is not a known format ({known}).")


def _ending_check(
    endings: Sequence[str],
) -> Callable[[click.Context, click.Parameter, Path | None], Path | None]:
    """Return a callback that applies :func:`check_ending`; without endings, it accepts all."""

    def callback(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
        if value is not None and endings:
            check_ending(value, endings)
        return value

    return callback


def output(
    help: str, *, required: bool = True, endings: Sequence[str] = (), cls: type | None = None
) -> Callable[[F], F]:
    """Return the option ``-o/--output``; ``endings`` are those of the names of its format."""
    return output_option("-o", "--output", required=required, help=help, endings=endings, cls=cls)


def output_option(*names: str, help: str, endings: Sequence[str], **more: Any) -> Callable[[F], F]:
    """Return an option that names a file to write, with a name that has one of ``endings``."""
    return click.option(*names, type=PATH, callback=_ending_check(endings), help=help, **more)


overwrite = click.option("--overwrite", is_flag=True, help="Replace the output if it exists.")

open_page = click.option("--open", "open_page", is_flag=True, help="Open the page in a browser.")


def _json(ctx: click.Context, param: click.Parameter, value: bool) -> bool:
    console.set_json(value)
    return value


def json_flag(content: str) -> Callable[[F], F]:
    """Return the option ``--json`` of a command that prints ``content``."""
    help = f"Print {content} to stdout instead of text."
    return click.option("--json", "as_json", is_flag=True, help=help, callback=_json)


as_json = json_flag("one JSON object")

method = click.option(
    "--method",
    type=click.Choice(("bundle", "field", "joint", "lattice", "paper")),
    default=None,
    help="Algorithm: `paper` is the published one; the default is more accurate (`bundle` for "
    "lighthouse, `joint` for polaris, `lattice` for dots, `field` for landmarks).",
)

artifact = input_option(
    "--artifact",
    help="Scene, tags, manifest or map (.toml) to use instead of the session's.",
)


def number(*names: str, default: Any, help: str, **more: Any) -> Callable[[Any], Any]:
    """Return an option with a default, which also determines the type."""
    more.setdefault("type", type(default))
    return click.option(*names, default=default, show_default=True, help=help, **more)


def verbosity(command: F) -> F:
    """Add ``-q/--quiet`` and ``-v/--verbose``, which set the verbosity of the console."""

    def callback(level: int) -> Callable[[click.Context, click.Parameter, bool], None]:
        def set_level(ctx: click.Context, param: click.Parameter, value: bool) -> None:
            if value:
                console.set_verbosity(level)

        return set_level

    for short, name, level, text in (
        ("-v", "--verbose", 1, "Print more messages, and tracebacks of errors."),
        ("-q", "--quiet", -1, "Print only results and errors."),
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
        ``path`` is one of ``inputs`` (even with ``--overwrite``), exists and ``overwrite`` is
        false, or is not a file.
    MissingDataError
        Its folder does not exist.
    """
    from locatk.formats.output import check_output

    if path.exists() and any(path.samefile(item) for item in inputs if item.exists()):
        raise OutputExistsError(
            "the output is one of the inputs", file=path, hint="Choose another -o"
        )
    check_output(path, overwrite=overwrite)


def prepare_folder(
    folder: Path,
    files: Sequence[Path],
    *,
    overwrite: bool,
    inputs: Sequence[Path] = (),
    option: str = "-o",
) -> None:
    """Create the folder for several outputs if it does not exist, and no output is refused.

    Parameters
    ----------
    folder : Path
        Named with ``option``.
    files : sequence of Path
        Outputs, in this folder and elsewhere.
    overwrite, inputs
        See :func:`guard_output`.
    option : str

    Raises
    ------
    OutputExistsError, MissingDataError
        ``folder`` is a file, or :func:`guard_output` refuses an output.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputExistsError(
            f"there are several outputs, but {option} is a file",
            file=folder,
            hint=f"Name a folder with {option}",
        )
    for path in files:
        if path.parent != folder or folder.exists():
            guard_output(path, overwrite=overwrite, inputs=inputs)
    folder.mkdir(parents=True, exist_ok=True)


def load(target: str) -> Any:
    """Import and return the object ``"package.module:name"``."""
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)
