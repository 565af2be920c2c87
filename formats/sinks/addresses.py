"""Addresses of sinks: ``scheme://host:port/path?key=value``, or ``scheme:rest``."""

from __future__ import annotations

from dataclasses import dataclass, field
from urllib.parse import parse_qsl, urlsplit

from locatk.core.errors import InputError

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class SinkAddress:
    """Parts of an address.

    Attributes
    ----------
    text : str
        As given by the user.
    scheme : str
        In lower case, as in ``"udp"``.
    host : str or None
    port : int or None
    path : str
        Without the leading slash; for ``scheme:rest`` the rest.
    options : dict of str to str
    """

    text: str
    scheme: str
    host: str | None = None
    port: int | None = None
    path: str = ""
    options: dict[str, str] = field(default_factory=dict)

    def require_port(self) -> int:
        """Return the port.

        Raises
        ------
        InputError
            The address has none.
        """
        if self.port is None:
            raise InputError(f"no port in {self.text}", hint=f"Example: {self.scheme}://host:9000")
        return self.port

    def reject_unknown_options(self, *known: str) -> None:
        """Raise an InputError if there is an option that is not one of ``known``."""
        unknown = [name for name in self.options if name not in known]
        if unknown:
            hint = f"Known: {', '.join(known)}" if known else f"{self.scheme} has no options"
            raise InputError(f"unknown option {unknown[0]!r} of {self.text}", hint=hint)


def parse_address(text: str) -> SinkAddress:
    """Return the parts of an address.

    Raises
    ------
    InputError
        It has no scheme, or an invalid port.
    """
    scheme, colon, rest = text.partition(":")
    if not (colon and scheme.isidentifier()):
        raise InputError(f"{text!r} is no address of a sink", hint="Example: udp://localhost:9000")
    if not rest.startswith("//"):
        return SinkAddress(text, scheme.lower(), path=rest)
    parts = urlsplit(text)
    try:
        port = parts.port
    except ValueError:
        raise InputError(f"invalid port in {text}", hint="Give 1 to 65535") from None
    return SinkAddress(
        text,
        scheme.lower(),
        parts.hostname,
        port,
        parts.path.lstrip("/"),
        dict(parse_qsl(parts.query, keep_blank_values=True)),
    )
