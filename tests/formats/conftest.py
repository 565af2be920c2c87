"""What tests of formats share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from locatk.core.errors import ArtifactError
from locatk.formats.artifacts.schema import Artifact


@pytest.fixture
def refused() -> Callable[..., None]:
    """``refused(TAGS, text, where, words)``: the text is no artifact of this kind, and the
    error is one line that names the file, the key (None for the whole) and why."""

    def check(artifact: Artifact[Any], text: str, where: str | int | None, words: str) -> None:
        with pytest.raises(ArtifactError) as caught:
            artifact.loads(text, file=artifact.file)
        error = caught.value
        assert error.where == where
        assert words in error.message
        assert "\n" not in str(error)
        place = artifact.file if where is None else f"{artifact.file}:{where}"
        assert str(error) == f"{place}: {error.message}"

    return check
