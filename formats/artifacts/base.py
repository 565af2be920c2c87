"""What every artifact can do: be written as TOML, read again, and be found in a session.

The modules of the artifacts (:mod:`.tags`, :mod:`.maps`, ...) say what is in a table; the
functions that each of them offers (``read_tags``, ``attached_map``, ...) are the methods of
an :class:`Artifact`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from locatk.formats.artifacts import toml
from locatk.formats.artifacts.toml import Table
from locatk.formats.output import atomic_write, tool_version

if TYPE_CHECKING:
    from locatk.formats.sessions.reader import Session

T = TypeVar("T")
"""What the artifact is in :mod:`locatk.core`."""


@dataclass(frozen=True)
class Artifact(Generic[T]):
    """An artifact as a file.

    Attributes
    ----------
    file : str
        Name of the attachment that holds it in a session or a solution, ``"tag.toml"``.
    dumps : callable
        TOML text of it; the same artifact gives the same text.
    parse : callable
        It, of a table; raises ArtifactError, which names the key and what was expected.
    """

    file: str
    dumps: Callable[[T], str]
    parse: Callable[[Table], T]

    def write(self, path: str | os.PathLike[str], value: T, *, overwrite: bool = False) -> None:
        """Write it as TOML.

        Raises
        ------
        OutputExistsError, MissingDataError
            See :func:`locatk.formats.output.atomic_write`.
        """
        with atomic_write(path, overwrite=overwrite) as stream:
            stream.write(self.dumps(value).encode())

    def read(self, path: str | os.PathLike[str]) -> T:
        """Read what a person or :meth:`write` has written.

        Raises
        ------
        MissingDataError
            There is no such file.
        ArtifactError
            It is no valid artifact of this kind; the error names the key and what was
            expected.
        """
        return self.parse(toml.read(path))

    def loads(self, text: str | bytes, *, file: str | os.PathLike[str] | None = None) -> T:
        """The artifact of TOML text; ``file`` is named in errors.

        Raises
        ------
        ArtifactError
            A key is missing, unknown or wrong, or what they tell cannot be; the error names
            it and what was expected.
        """
        return self.parse(toml.loads(text, f"<{self._stem}>" if file is None else file))

    def attached(self, session: Session) -> T | None:
        """The artifact that is attached to a session, or None.

        Raises
        ------
        FormatError, ArtifactError
            The attachment is damaged, or no valid artifact of this kind.
        """
        return self._attached(session, self.file)

    def attached_for(self, session: Session, device: str | None = None) -> T | None:
        """The artifact that is attached to a session for ``device``, or None.

        That is :meth:`file_for` the device where the devices of a session have different
        ones, ``file`` where they share one.

        Raises
        ------
        FormatError, ArtifactError
            As :meth:`attached`.
        """
        own = None if device is None else self._attached(session, self.file_for(device))
        return self._attached(session, self.file) if own is None else own

    def file_for(self, device: str) -> str:
        """Name of the attachment that holds the artifact of one device alone."""
        return f"{self._stem}-{device}.toml"

    @property
    def _stem(self) -> str:
        return self.file.removesuffix(".toml")

    def _attached(self, session: Session, name: str) -> T | None:
        data = session.attachment(name)
        return None if data is None else self.loads(data, file=f"{session.path}:{name}")


def head(name: str, version: int) -> dict[str, Any]:
    """The keys with which every artifact begins; :func:`.toml.check_format` reads them."""
    return {"format": name, "format_version": version, "tool_version": tool_version()}
