"""Search for sessions by path, pattern or URL."""

from __future__ import annotations

from hypothesis import example, given
from hypothesis import strategies as st

from locatk.core.errors import LocatkError
from locatk.formats.pipeline.session_search import find_sessions


@given(st.text(max_size=30))
@example("\0/*")
def test_any_name_is_found_or_one_error(name: str) -> None:
    try:
        found = find_sessions([name])
    except LocatkError:
        return
    assert found.sessions
