"""The house: arrows run one way, and every room is in the package."""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

LAYERS = ("cli", "core", "formats")
ALLOWED = {
    "core": {"core"},
    "formats": {"core", "formats"},
    "cli": {"core", "formats", "cli"},
}
NOT_IN_CORE = {"click", "mcap", "google", "serial", "reportlab", "matplotlib", "time", "datetime"}
"""No terminal, no files, no clock."""


def modules(root: Path, layer: str) -> list[Path]:
    return [p for p in sorted((root / layer).rglob("*.py")) if not p.name.endswith("_pb2.py")]


def imported(nodes: Iterator[ast.AST]) -> set[str]:
    """Dotted names that the import statements among ``nodes`` name."""
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def at_top(node: ast.AST) -> Iterator[ast.AST]:
    """What runs when a module is imported; not what is under TYPE_CHECKING."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
            continue
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        yield child
        yield from at_top(child)


@pytest.mark.parametrize("layer", LAYERS)
def test_arrows_run_one_way(root: Path, layer: str) -> None:
    found = modules(root, layer)
    assert found
    for path in found:
        for name in imported(ast.walk(ast.parse(path.read_text(encoding="utf-8")))):
            if name.startswith("locatk."):
                assert name.split(".")[1] in ALLOWED[layer], f"{path} imports {name}"


def test_core_is_pure(root: Path) -> None:
    for path in modules(root, "core"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        tops = {name.split(".")[0] for name in imported(ast.walk(tree))}
        assert not tops & NOT_IN_CORE, f"{path} imports {tops & NOT_IN_CORE}"
        calls = {
            node.func.id
            for node in ast.walk(tree)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert not calls & {"open", "print", "input"}, path


def test_commands_import_little_at_the_top(root: Path) -> None:
    bare = {"locatk.core.errors", "locatk.core.units"}  # they take the standard library alone
    light = {"click", "locatk.cli", *bare} | set(sys.stdlib_module_names)
    for item in bare:
        path = root / item.removeprefix("locatk.").replace(".", "/")
        tree = ast.parse(path.with_suffix(".py").read_text(encoding="utf-8"))
        tops = {name.split(".")[0] for name in imported(at_top(tree))}
        assert tops <= set(sys.stdlib_module_names), item
    for path in modules(root, "cli"):
        for name in imported(at_top(ast.parse(path.read_text(encoding="utf-8")))):
            known = name.split(".")[0] in light or any(
                name == item or name.startswith(item + ".") for item in light
            )
            assert known, f"{path} imports {name} at its top"


def test_every_package_is_installed(root: Path) -> None:
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    listed = set(settings["tool"]["setuptools"]["packages"])
    folders = {path.parent for layer in LAYERS for path in (root / layer).rglob("*.py")}
    there = {"locatk." + ".".join(folder.relative_to(root).parts) for folder in folders}
    assert listed == there
    for folder in folders:
        assert (folder / "__init__.py").exists(), f"{folder} has no __init__.py"


def test_modules_stay_small(root: Path) -> None:
    for layer in LAYERS:
        for path in modules(root, layer):
            lines = len(path.read_text(encoding="utf-8").splitlines())
            assert lines <= 400, f"{path} has {lines} lines"
