"""Texts of others on terminals, in file names and in spreadsheets."""

from __future__ import annotations

import ntpath
import unicodedata
from pathlib import PureWindowsPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.printable import (
    MAX_NAME_BYTES,
    escape_controls,
    file_name_part,
    spreadsheet_text,
    text_of_spreadsheet,
)

is_reserved = getattr(ntpath, "isreserved", lambda name: PureWindowsPath(name).is_reserved())
"""Python's own rule; ``PureWindowsPath.is_reserved`` is deprecated from 3.13 on."""

ANY_TEXT = st.text(st.characters(), max_size=30)  # with surrogates
DEVICES = st.builds(
    "{}{}".format,
    st.sampled_from(["CON", "nul", "Aux", "COM1", "LPT\u00b9"]),
    st.sampled_from(["", " ", ".a"]),
)
HOSTILE = st.text(st.sampled_from("a=+-@'\t\r\n\x1b\x9b\u202e\u2066\u200b\udcff./ "), max_size=12)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("robot-1 grün 机器人 ±1 µT\u202f\u00a0", "robot-1 grün 机器人 ±1 µT\u202f\u00a0"),
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("a\x9b31mb\rc\nd\te", r"a\x9b31mb\x0dc\x0ad\x09e"),
        ("abc\u202etxt.exe\u2066\u200f\u200b\ufeff", r"abc\u202etxt.exe\u2066\u200f\u200b\ufeff"),
        ("\u2028\u2029\U000e0041", r"\u2028\u2029\U000e0041"),
        (b"not\xffutf8\x80".decode("utf-8", "surrogateescape"), r"not\xffutf8\x80"),
        ("\ud800", r"\ud800"),
    ],
)
def test_invisible_characters_become_escapes(text: str, shown: str) -> None:
    assert escape_controls(text) == shown


def test_line_ends_can_be_kept() -> None:
    assert escape_controls("a\nb\x1b", keep="\n") == "a\nb\\x1b"


@given(ANY_TEXT | HOSTILE)
def test_nothing_invisible_is_left(text: str) -> None:
    shown = escape_controls(text)
    shown.encode()  # no surrogates
    assert not [c for c in shown if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")]
    assert escape_controls(shown) == shown


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("robot-1", "robot-1"),
        ("Gerät 7.a", "Gerät 7.a"),
        ("a/b\\c:d", "a_b_c_d"),
        ("../../etc/passwd", "_._.._etc_passwd"),
        ("-rf", "_rf"),
        (".bashrc", "_bashrc"),
        ("a\x1b[2J\u202eb\n\0", "a_[2J_b__"),
        ("", "_"),
        ("CON", "_CON"),
        ("nul", "_nul"),
        ("COM1.txt", "_COM1.txt"),
        ("lpt\u00b3 .a", "_lpt\u00b3 .a"),
        ("ConOut$", "_ConOut$"),
        ("com", "com"),
        ("com10", "com10"),
        ("console.con", "console.con"),
        ("a.", "a_"),
        ("a ", "a_"),
        ("a. ", "a._"),
        (".", "_"),
        ("a" * 149 + ". b", "a" * 149 + "_"),
    ],
)
def test_names_of_files(text: str, name: str) -> None:
    assert file_name_part(text) == name


@given(ANY_TEXT | HOSTILE | DEVICES, st.sampled_from([1, 20]))
def test_names_of_files_are_possible(text: str, times: int) -> None:
    name = file_name_part(text * times)
    assert 0 < len(name.encode()) <= MAX_NAME_BYTES
    assert not set(name) & set('/\\:*?"<>|\0\n')
    assert name[0] not in ".-"
    assert name[-1] not in ". "
    assert not is_reserved(name)


@pytest.mark.parametrize("text", ["=1+1", "+4", "-cmd", "@x", "\t=1", "\r=1", "\n=1", "\uff1d1"])
def test_formulas_become_texts(text: str) -> None:
    assert spreadsheet_text(text) == "'" + text


def test_plain_texts_stay_in_spreadsheets() -> None:
    for text in ("robot-1", "", "'quoted'", "a=b", " x"):
        assert spreadsheet_text(text) == text


@given(ANY_TEXT | HOSTILE)
def test_spreadsheet_texts_round_trip(text: str) -> None:
    cell = spreadsheet_text(text)
    assert cell[:1] not in tuple("=+-@\t\r\n")
    assert text_of_spreadsheet(cell) == text
