"""Addresses of sinks: ``scheme://host:port/path?key=value``, or ``scheme:rest``."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from urllib.parse import parse_qsl, urlsplit

from locatk.core.errors import InputError

LOOPBACK = "127.0.0.1"

_PASSWORD = re.compile(r"(//[^/@]*?:).*(@)")


@dataclass(frozen=True)
class SinkAddress:
    """Parts of an address.

    Attributes
    ----------
    text : str
        As given by the user, with a password if there is one; see :attr:`public_text`.
    scheme : str
        In lower case, as in ``"udp"``.
    host : str or None
    port : int or None
    path : str
        Without the leading slash; for ``scheme:rest`` the rest.
    options : dict of str to str
    """

    text: str = field(repr=False)
    scheme: str
    host: str | None = None
    port: int | None = None
    path: str = ""
    options: dict[str, str] = field(default_factory=dict)

    @property
    def public_text(self) -> str:
        """The address without its password, for messages and status."""
        return _PASSWORD.sub(r"\1***\2", self.text)

    @property
    def host_and_port(self) -> str:
        """As in ``localhost:9000`` or ``[::1]:9000``."""
        host = f"[{self.host}]" if ":" in (self.host or "") else self.host
        return f"{host}:{self.port}"

    def with_path_options(self) -> SinkAddress:
        """Return the address with the options of a path ``rest?key=value`` in their place.

        Schemes of the form ``scheme:rest`` that have options call this.
        """
        path, _, query = self.path.partition("?")
        options = self.options | dict(parse_qsl(query, keep_blank_values=True))
        return replace(self, path=path, options=options)

    def choice(self, option: str, *values: str) -> str:
        """Return the value of an option that has few; the first one is the default.

        Raises
        ------
        InputError
            It has another value.
        """
        value = self.options.get(option, values[0])
        if value not in values:
            raise InputError(
                f"{option}={value} in {self.public_text}", hint=f"Choose one of {', '.join(values)}"
            )
        return value

    def integer(self, option: str, default: int, least: int, most: int) -> int:
        """Return the value of an option that is an integer from ``least`` to ``most``.

        Raises
        ------
        InputError
            It is none.
        """
        text = self.options.get(option, str(default))
        if not (text.isascii() and text.isdigit() and least <= int(text) <= most):
            raise InputError(
                f"{option}={text} in {self.public_text}", hint=f"Give {least} to {most}"
            )
        return int(text)

    def require_host(self) -> str:
        """Return the host.

        Raises
        ------
        InputError
            The address has none.
        """
        if not self.host:
            raise InputError(
                f"no host in {self.public_text}", hint=f"Example: {self.scheme}://localhost:9000"
            )
        return self.host

    def require_port(self) -> int:
        """Return the port.

        Raises
        ------
        InputError
            The address has none.
        """
        if self.port is None:
            raise InputError(
                f"no port in {self.public_text}", hint=f"Example: {self.scheme}://host:9000"
            )
        return self.port

    def reject_unknown_options(self, *known: str) -> None:
        """Raise an InputError if there is an option that is not one of ``known``."""
        unknown = [name for name in self.options if name not in known]
        if unknown:
            hint = f"Known: {', '.join(known)}" if known else f"{self.scheme} has no options"
            raise InputError(f"unknown option {unknown[0]!r} of {self.public_text}", hint=hint)


def parse_address(text: str) -> SinkAddress:
    """Return the parts of an address.

    Raises
    ------
    InputError
        It has no scheme, or an invalid port.
    """
    scheme, colon, rest = text.partition(":")
    if not (colon and scheme.isidentifier()):
        shown = SinkAddress(text, scheme).public_text
        raise InputError(f"{shown!r} is no address of a sink", hint="Example: udp://localhost:9000")
    if not rest.startswith("//"):
        return SinkAddress(text, scheme.lower(), path=rest)
    shown = SinkAddress(text, scheme).public_text
    try:
        parts = urlsplit(text)
    except ValueError:
        raise InputError(f"invalid host in {shown}", hint="Example: udp://[::1]:9000") from None
    try:
        port = parts.port
    except ValueError:
        raise InputError(f"invalid port in {shown}", hint="Give 1 to 65535") from None
    return SinkAddress(
        text,
        scheme.lower(),
        parts.hostname,
        port,
        parts.path.lstrip("/"),
        dict(parse_qsl(parts.query, keep_blank_values=True)),
    )
