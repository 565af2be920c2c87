"""Rejected observations in reports: every reason code of core has a sentence."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("plotly")

from locatk.formats.report import rejections

ROOT = Path(__file__).resolve().parents[3]

CALLS = {
    "reject": 0,
    "_add_rejected": 1,
    "keep": 1,
    "select_stations": 2,
    "_refusal": 2,
    "TagObservation": 3,
}
"""Functions of core that take a reason code, and the index of that argument."""

NAME = re.compile(r"(^|\W)(refused|rejected|reason)\b")
"""Variables, fields and keys that contain reason codes."""

RETURNING = {"_fit_reason", "_missing_reason", "_misplaced"}
"""Functions of core that return a reason code."""

KEYED = {"RESTORATIONS"}
"""Dictionaries of core whose keys are reason codes."""


def reasons(system: str) -> set[str]:
    """Every reason code in the sources of a system."""
    found: set[str] = set()
    for path in sorted((ROOT / "core" / system).rglob("*.py")):
        # Demodulation counts bursts, and importers label pulses: no observations of a solution.
        is_of_solver = path.parent.name not in ("demodulation", "simulation")
        if is_of_solver and path.name not in (
            "study.py",
            "camera_views.py",
            "plane_labels.py",
        ):
            tree = ast.parse(path.read_text())
            constants = {
                node.targets[0].id: node.value
                for node in tree.body
                if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
            }
            for expression in reason_expressions(tree):
                for leaf in ast.walk(expression):
                    node = constants.get(leaf.id) if isinstance(leaf, ast.Name) else leaf
                    if isinstance(node, ast.Constant) and isinstance(node.value, str):
                        found.add(node.value)
    return {text for text in found if re.fullmatch(r"[a-z]+(_[a-z]+)*", text)}


def reason_expressions(tree: ast.AST) -> Iterator[ast.AST]:
    """Expressions that contain reason codes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            yield from node.args[CALLS[name] :][:1] if name in CALLS else ()
            yield from (each.value for each in node.keywords if NAME.match(each.arg or ""))
        elif isinstance(node, ast.Assign | ast.AugAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(NAME.search(ast.unparse(target)) for target in targets):
                yield from (*targets, node.value)
        elif isinstance(node, ast.AnnAssign) and ast.unparse(node.target) in KEYED:
            assert isinstance(node.value, ast.Dict)
            yield from (key for key in node.value.keys if key is not None)
        elif isinstance(node, ast.FunctionDef) and node.name in RETURNING:
            yield from (each for each in ast.walk(node) if isinstance(each, ast.Return))


@pytest.mark.slow
@pytest.mark.parametrize("system", list(rejections.REASONS))
def test_every_reason_of_core_has_a_sentence_and_no_other_has(system: str) -> None:
    given, known = reasons(system), set(rejections.REASONS[system]())
    assert len(given) > 5
    assert given - known == set()
    assert known - given == set()


@pytest.mark.parametrize("system", list(rejections.REASONS))
def test_explanations_are_sentences(system: str) -> None:
    for code, reason in rejections.REASONS[system]().items():
        assert reason.sentence[0].isupper(), code
        assert reason.sentence.endswith("."), code
        assert "  " not in reason.sentence
        assert "nan" not in reason.sentence
        assert reason.unit in ("sweeps", "moments", "frames", "passes", "visits")


@pytest.mark.parametrize("system", list(rejections.REASONS))
def test_reasons_are_those_of_the_docs(system: str) -> None:
    docs = (ROOT / "docs" / f"{system}.md").read_text()
    published = {"no_dots", "no_window", "no_orientation"}  # of --method paper
    for reason in set(rejections.REASONS[system]()) - published:
        assert f"`{reason}`" in docs, reason
