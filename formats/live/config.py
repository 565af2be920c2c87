"""Permanent set-up of ``locatk live``: the file ``live.toml``, and inputs on the command line."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from locatk.core.errors import InputError
from locatk.formats.artifacts.kinds import Integer, InvalidValueError, ListOf, Number, Text
from locatk.formats.artifacts.schema import Artifact, Key, Table, Tables, Values
from locatk.formats.capture.camera import FORMATS
from locatk.formats.capture.replay import PREFIX as REPLAY
from locatk.formats.capture.setup import CaptureRequest

TOKEN_BYTES = 1024
"""Largest size of a file that contains a token."""


@dataclass(frozen=True)
class LiveConfig:
    """Content of ``live.toml``.

    Attributes
    ----------
    inputs : tuple of CaptureRequest
        Without artifacts and outputs.
    artifacts : tuple of str
        Files, relative to the folder of the configuration.
    sinks : tuple of str
        Addresses.
    record : str
        File to record into; ``""`` to record nothing.
    rotate_s : float or None
        Time after which the recording continues in a new file.
    token_file : str
        File with the secret for clients; ``""`` for none.
    """

    inputs: tuple[CaptureRequest, ...] = ()
    artifacts: tuple[str, ...] = ()
    sinks: tuple[str, ...] = ()
    record: str = ""
    rotate_s: float | None = None
    token_file: str = ""


def _input_of(values: Values) -> CaptureRequest:
    return _request(values["port"], **{k: v for k, v in values.items() if k != "port"})


def _request(port: str, **given: Any) -> CaptureRequest:
    """Return the request of an input; a replay has the times of its recording."""
    given = {name: value for name, value in given.items() if value is not None}
    return CaptureRequest(
        port=port,
        output=None,
        keeps_time=port.lower().startswith(REPLAY),
        **{"device": "auto", **given},
    )


def _input_values(request: CaptureRequest) -> Values:
    return vars(request)


def _config_of(values: Values) -> LiveConfig:
    if values["rotate_s"] is not None and not values["record"]:
        raise InvalidValueError("nothing is recorded", "rotate_s", "Add record")
    return LiveConfig(**values)


INPUT_KEYS = (
    Key("port", Text(is_blank_allowed=False), "as of `locatk capture`"),
    Key("device", Text(), "kind of device, as of `locatk capture --device`", "auto"),
    Key("name", Text(is_blank_allowed=False), "name of the device", None, "`robot`, `camera`"),
    Key("baud", Integer(1), "baud rate", None, "that of the device"),
    Key("columns", ListOf(Text()), "names of the values in a line, of `lines`", ()),
    Key("speed", Number(0.0), "speed of a replay or a video file; 0: as fast as possible", 1.0),
    Key("image", Text(FORMATS), "format of recorded camera frames", "jpeg"),
)
"""Keys of an input."""

CONFIG: Artifact[LiveConfig] = Artifact(
    "live.toml",
    "locatk-live",
    Table(
        (
            Key("artifacts", ListOf(Text(is_blank_allowed=False)), "artifacts (.toml, .mcap)", ()),
            Key("sinks", ListOf(Text(is_blank_allowed=False)), "addresses, as of `--to`", ()),
            Key("record", Text(), "session to record; `%Y%m%d-%H%M%S` is its start", ""),
            Key("rotate_s", Number(1.0), "duration of one file of the recording", None, "one file"),
            Key("token_file", Text(), "file with the secret for clients of servers", ""),
            Key("inputs", Tables(Table(INPUT_KEYS, _input_of, _input_values), min_count=1)),
        ),
        _config_of,
        vars,
    ),
    comment="Permanent set-up of `locatk live --config live.toml`.",
)
"""The configuration as a file."""


def read_config(path: Path) -> LiveConfig:
    """Read a configuration; its files become relative to the current folder.

    Raises
    ------
    MissingDataError, ArtifactError
        See :meth:`locatk.formats.artifacts.schema.Artifact.read`.
    """
    config = CONFIG.read(path)
    return replace(
        config,
        artifacts=tuple(str(path.parent / name) for name in config.artifacts),
        record=str(path.parent / config.record) if config.record else "",
        token_file=str(path.parent / config.token_file) if config.token_file else "",
    )


def parse_input(text: str) -> CaptureRequest:
    """Return the input ``PORT key=value ...``.

    Raises
    ------
    InputError
        A key is unknown, or its value invalid.
    """
    try:
        port, *pairs = shlex.split(text)
    except ValueError:
        raise InputError(
            f"no port in {text!r}", hint="Example: /dev/ttyACM0 device=lines"
        ) from None
    table: dict[str, Any] = {"port": port}
    kinds = {key.name: key.kind for key in INPUT_KEYS}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        kind = kinds.get(name)
        if not equals or kind is None or name == "port":
            known = ", ".join(key.name for key in INPUT_KEYS[1:])
            raise InputError(f"{pair!r} of the input {port} is unknown", hint=f"Known: {known}")
        if isinstance(kind, ListOf):
            table[name] = value.split(",")
        elif isinstance(kind, Integer | Number):
            try:
                table[name] = int(value) if isinstance(kind, Integer) else float(value)
            except ValueError:
                raise InputError(
                    f"{name} of the input {port} is {value!r}, not a number",
                    hint="Example: baud=9600",
                ) from None
        else:
            table[name] = value
    try:
        request: CaptureRequest = Table(INPUT_KEYS, _input_of).parse(table)
    except InvalidValueError as error:
        raise InputError(
            f"{error.key} of the input {port}: {error.message}", hint=error.hint
        ) from None
    return request


def single_input(port: str, **given: Any) -> CaptureRequest:
    """Return the input of the options of the command; None selects a default."""
    return _request(port, **given)


def with_recording(
    requests: tuple[CaptureRequest, ...], output: Path, **given: Any
) -> tuple[CaptureRequest, ...]:
    """Return the inputs with their outputs, and further fields of :class:`CaptureRequest`.

    With several inputs, the number of each is appended to the name of its file.
    """
    if len(requests) == 1:
        return (replace(requests[0], output=output, **given),)
    return tuple(
        replace(each, output=output.with_name(f"{output.stem}-{n}{output.suffix}"), **given)
        for n, each in enumerate(requests, 1)
    )


def recording_path(text: str, now: Any) -> Path:
    """Return the path of a recording; ``now`` (a datetime) replaces ``%Y`` and the like."""
    return Path(now.strftime(text) if "%" in text else text)


def read_token(path: str | os.PathLike[str]) -> str:
    """Read the secret for clients from a file.

    Raises
    ------
    MissingDataError, InputError
        It cannot be read, or is no single line of at least 8 characters.
    """
    from locatk.formats.files import read_bytes

    token = read_bytes(path, TOKEN_BYTES).decode("utf-8", "replace").strip()
    if len(token) < 8 or not token.isprintable() or " " in token:
        raise InputError(
            "not a token", file=path, hint="Write one line of at least 8 letters and digits"
        )
    return token
