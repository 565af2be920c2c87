"""Rejected observations in reports: every reason code of core has a sentence."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("plotly")

from locatk.formats.report import rejections

ROOT = Path(__file__).resolve().parents[3]

ARGUMENTS = {
    "reject": 0,
    "_add_rejected": 1,
    "keep": 1,
    "select_stations": 2,
    "_refusal": 2,
    "_answer": 2,
    "TagObservation": 3,
}
"""Calls in core that give a reason, and which of their arguments it is."""

NAMES = {"refused", "rejected", "reason", "why"}
"""What variables, fields and keys are called that hold one."""

RETURNING = {"_fit_reason", "_missing_reason", "_misplaced"}
"""Functions that answer with one."""


def reasons(system: str) -> set[str]:
    """Every reason that the sources of a system can give."""
    found: set[str] = set()
    for path in sorted((ROOT / "core" / system).rglob("*.py")):
        # Demodulation counts bursts, which are no observations of a solution.
        is_of_solver = path.parent.name not in ("demodulation", "simulation")
        if is_of_solver and path.name not in ("study.py", "camera_views.py"):
            tree = ast.parse(path.read_text())
            constants = {
                target.id: node.value.value
                for node in tree.body
                if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
                for target in node.targets
                if isinstance(target, ast.Name)
            }
            for value in _given(tree):
                found |= _texts(value, constants)
    return {text for text in found if re.fullmatch(r"[a-z]+(_[a-z]+)*", text)}


def _given(tree: ast.AST) -> Iterator[ast.AST]:
    """Expressions that may be a reason."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in ARGUMENTS and len(node.args) > ARGUMENTS[name]:
                yield node.args[ARGUMENTS[name]]
            yield from (each.value for each in node.keywords if each.arg in NAMES)
        elif isinstance(node, ast.Assign):
            targets = [
                each
                for target in node.targets
                for each in (target.elts if isinstance(target, ast.Tuple) else [target])
            ]
            if any(_holds(target) for target in targets):
                yield node.value
            yield from (
                target.slice
                for target in targets
                if isinstance(target, ast.Subscript) and _holds(target.value)
            )
        elif isinstance(node, ast.AugAssign) and _holds(node.target):
            assert isinstance(node.target, ast.Subscript)
            yield node.target.slice
        elif isinstance(node, ast.FunctionDef) and node.name in RETURNING:
            yield from (each.value for each in ast.walk(node) if isinstance(each, ast.Return))


def _holds(target: ast.AST) -> bool:
    if isinstance(target, ast.Subscript):
        key = target.slice
        named = isinstance(key, ast.Constant) and key.value in NAMES
        return named or _holds(target.value)
    return getattr(target, "attr", getattr(target, "id", None)) in NAMES


def _texts(value: ast.AST | None, constants: dict[str, Any]) -> set[str]:
    """Texts that an expression may be."""
    if isinstance(value, ast.Constant):
        return {value.value} if isinstance(value.value, str) else set()
    if isinstance(value, ast.Name):
        known = constants.get(value.id)
        return {known} if isinstance(known, str) else set()
    if isinstance(value, ast.IfExp):
        return _texts(value.body, constants) | _texts(value.orelse, constants)
    if isinstance(value, ast.Dict):
        return set().union(*(_texts(key, constants) for key in value.keys))
    if isinstance(value, ast.Tuple):
        return set().union(*(_texts(each, constants) for each in value.elts))
    return set()


@pytest.mark.slow
@pytest.mark.parametrize("system", list(rejections.REASONS))
def test_every_reason_of_core_has_a_sentence_and_no_other_has(system: str) -> None:
    given, known = reasons(system), set(rejections.REASONS[system]())
    assert len(given) > 5
    assert given - known == set()
    assert known - given == set()


@pytest.mark.parametrize("system", list(rejections.REASONS))
def test_sentences_are_sentences(system: str) -> None:
    for reason, told in rejections.REASONS[system]().items():
        assert told.sentence[0].isupper(), reason
        assert told.sentence.endswith("."), reason
        assert "  " not in told.sentence
        assert "nan" not in told.sentence
        assert told.unit in ("sweeps", "moments", "frames", "passes", "visits")


@pytest.mark.parametrize("system", list(rejections.REASONS))
def test_reasons_are_those_of_the_docs(system: str) -> None:
    docs = (ROOT / "docs" / f"{system}.md").read_text()
    published = {"no_dots", "no_window", "no_orientation"}  # of --method paper
    for reason in set(rejections.REASONS[system]()) - published:
        assert f"`{reason}`" in docs, reason
