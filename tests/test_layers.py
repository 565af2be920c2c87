"""Structure of the package: layers, import cycles, dependencies of core, installed packages."""

from __future__ import annotations

import ast
import functools
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

LAYERS = ("cli", "core", "formats")
ALLOWED_IMPORTS = {
    "core": {"core"},
    "formats": {"core", "formats"},
    "cli": {"core", "formats", "cli"},
}
FORBIDDEN_IN_CORE = {
    "click", "mcap", "google", "serial", "reportlab", "matplotlib", "time", "datetime",
}  # fmt: skip
"""Core is pure computation: no terminal, no files, no clock."""


def find_modules(root: Path, layer: str) -> list[Path]:
    """Return the Python files of a layer, except generated ones."""
    return [p for p in sorted((root / layer).rglob("*.py")) if not p.name.endswith("_pb2.py")]


@functools.cache
def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a module; parsing all modules takes seconds."""
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def names_in(path: Path) -> frozenset[str]:
    """Return the dotted names in all import statements of a module."""
    return frozenset(imported_names(ast.walk(parse(path))))


def imported_names(nodes: Iterable[ast.AST]) -> set[str]:
    """Return the dotted names in the import statements among ``nodes``.

    ``from a import b`` gives ``a.b``, which is a module or a name in the module ``a``.
    """
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def walk_import_time(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that run when a module is imported: no functions, no TYPE_CHECKING."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
            continue
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        yield child
        yield from walk_import_time(child)


# ---- import cycles


def import_graph(root: Path, layers: Iterable[str] = LAYERS) -> dict[str, set[str]]:
    """Return the modules that each module imports, by their names below ``locatk``.

    All imports count: at the top, inside functions, and under TYPE_CHECKING. A package is the
    module of its ``__init__.py``; importing one of its modules does not count as importing it.
    """
    paths = {}
    for layer in layers:
        for path in find_modules(root, layer):
            parts = path.relative_to(root).with_suffix("").parts
            paths[".".join(part for part in parts if part != "__init__")] = path
    graph = {}
    for module, path in paths.items():
        imports = set()
        for name in names_in(path):
            name = name.removeprefix("locatk.")
            # A name that is not a module is defined in the module before its last dot.
            imports.add(name if name in paths else name.rpartition(".")[0])
        graph[module] = imports & paths.keys()
    return graph


def find_cycle(graph: dict[str, set[str]]) -> list[str] | None:
    """Return the modules along an import cycle, the first one repeated, or None."""
    done: set[str] = set()
    for start in sorted(graph):
        # Depth-first search with the iterators of the modules on the current path.
        path, pending = [start], [iter(sorted(graph[start]))]
        while path:
            module = next(pending[-1], None)
            if module is None:
                done.add(path.pop())
                pending.pop()
            elif module in path:
                return [*path[path.index(module) :], module]
            elif module not in done:
                path.append(module)
                pending.append(iter(sorted(graph[module])))
    return None


def write_package(root: Path, **sources: str) -> Path:
    """Write modules of a package ``core.tiny``."""
    folder = root / "core" / "tiny"
    folder.mkdir(parents=True)
    (root / "core" / "__init__.py").write_text("")
    (folder / "__init__.py").write_text("")
    for name, source in sources.items():
        (folder / f"{name}.py").write_text(source)
    return root


@pytest.mark.parametrize(
    "back",
    [
        "from locatk.core.tiny.first import value\n",
        "from locatk.core.tiny import first\n",
        "import locatk.core.tiny.first\n",
        "def later():\n    from locatk.core.tiny.first import value\n    return value\n",
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from locatk.core.tiny.first import value\n",
    ],
    ids=["top", "module", "plain", "function", "type-checking"],
)
def test_import_cycles_of_every_kind_are_found(tmp_path: Path, back: str) -> None:
    root = write_package(
        tmp_path,
        first="from locatk.core.tiny import second\nvalue = 1\n",
        second="from locatk.core.tiny import third\n",
        third=back,
        other="from locatk.core.tiny import first\n",
    )
    cycle = find_cycle(import_graph(root, ["core"]))
    assert cycle == [f"core.tiny.{name}" for name in ("first", "second", "third", "first")]


def test_a_package_and_its_module_can_form_a_cycle(tmp_path: Path) -> None:
    root = write_package(tmp_path, first="from locatk.core.tiny import value\n")
    (root / "core/tiny/__init__.py").write_text("from locatk.core.tiny.first import value\n")
    assert find_cycle(import_graph(root, ["core"])) == [
        "core.tiny", "core.tiny.first", "core.tiny",
    ]  # fmt: skip


def test_a_diamond_is_not_a_cycle(tmp_path: Path) -> None:
    root = write_package(
        tmp_path,
        first="from locatk.core.tiny import second, third\n",
        second="from locatk.core.tiny import fourth\nimport numpy\n",
        third="def later():\n    from locatk.core.tiny.fourth import value\n    return value\n",
        fourth="value = 1\n",
    )
    assert find_cycle(import_graph(root, ["core"])) is None


@pytest.mark.slow
def test_no_import_cycles(root: Path) -> None:
    graph = import_graph(root)
    # There are hundreds of modules: an empty graph would have no cycle either.
    assert sum(map(len, graph.values())) > 1000
    cycle = find_cycle(graph)
    assert cycle is None, "import cycle: " + " -> ".join(cycle or [])


@pytest.mark.slow
@pytest.mark.parametrize("layer", LAYERS)
def test_no_import_cycles_between_packages(root: Path, layer: str) -> None:
    """A package is a folder of a layer, such as ``formats.sessions``."""
    packages: dict[str, set[str]] = {}
    for module, imports in import_graph(root, [layer]).items():
        package, *_ = module.split(".")[1:] or [layer]
        used = {name.split(".")[1] for name in imports if "." in name}
        packages.setdefault(package, set()).update(used - {package})
    cycle = find_cycle({name: used & packages.keys() for name, used in packages.items()})
    assert cycle is None, f"import cycle in {layer}: " + " -> ".join(cycle or [])


# ---- layers


@pytest.mark.slow
@pytest.mark.parametrize("layer", LAYERS)
def test_layers_import_only_layers_below(root: Path, layer: str) -> None:
    paths = find_modules(root, layer)
    assert paths
    for path in paths:
        for name in names_in(path):
            if name.startswith("locatk."):
                assert name.split(".")[1] in ALLOWED_IMPORTS[layer], f"{path} imports {name}"


@pytest.mark.slow
def test_core_is_pure_computation(root: Path) -> None:
    for path in find_modules(root, "core"):
        packages = {name.split(".")[0] for name in names_in(path)}
        assert not packages & FORBIDDEN_IN_CORE, f"{path} imports {packages & FORBIDDEN_IN_CORE}"
        calls = {
            node.func.id
            for node in ast.walk(parse(path))
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert not calls & {"open", "print", "input"}, path


@pytest.mark.slow
def test_commands_import_little_at_import_time(root: Path) -> None:
    """Commands start fast: numpy and the like are imported inside their functions."""
    light_modules = {
        "locatk.core.errors",
        "locatk.core.printable",
        "locatk.core.units",
        "locatk.formats.artifacts.kinds",
        "locatk.formats.settings.setting",
    }
    light = {"click", "locatk.cli", *light_modules} | set(sys.stdlib_module_names)
    for module in light_modules:
        path = root / module.removeprefix("locatk.").replace(".", "/")
        for name in imported_names(walk_import_time(parse(path.with_suffix(".py")))):
            is_standard = name.split(".")[0] in sys.stdlib_module_names
            assert is_standard or name.rpartition(".")[0] in light_modules, f"{module}: {name}"
    for path in find_modules(root, "cli"):
        for name in imported_names(walk_import_time(parse(path))):
            is_light = name.split(".")[0] in light or any(
                name == module or name.startswith(module + ".") for module in light
            )
            assert is_light, f"{path} imports {name} at its top"


@functools.cache
def defined_names(path: Path) -> frozenset[str]:
    """Return the names that a module imports or defines."""
    return frozenset(name.rpartition(".")[2] for name in names_in(path)) | {
        getattr(node, "name", getattr(node, "id", "")) for node in ast.walk(parse(path))
    }


@pytest.mark.slow
def test_imported_names_exist(root: Path) -> None:
    """A name imported from a package is one of its modules, or defined in its ``__init__``.

    mypy does not check that for packages with ``__getattr__``.
    """
    for path in [p for layer in LAYERS for p in find_modules(root, layer)]:
        for node in ast.walk(parse(path)):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("locatk"):
                continue
            package = root.joinpath(*(node.module or "").split(".")[1:])
            if not (package / "__init__.py").exists():
                continue
            defined = defined_names(package / "__init__.py")
            for alias in node.names:
                is_module = any((package / f"{alias.name}{end}").exists() for end in (".py", ""))
                assert is_module or alias.name in defined, (
                    f"{path}: no {alias.name} in {node.module}"
                )


SYSTEMS = ("dots", "landmarks", "lighthouse", "polaris")

SOLVER_STAGES = (
    "solver", "preprocessing", "detection", "identification", "demodulation", "localization",
    "devices", "published",
)  # fmt: skip
"""Modules and packages of a system that estimate; the simulators must not share their code."""


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_no_system_imports_another(root: Path, system: str) -> None:
    sisters = tuple(f"locatk.core.{other}." for other in SYSTEMS if other != system)
    paths = sorted((root / "core" / system).rglob("*.py"))
    assert len(paths) > 10
    for path in paths:
        assert not [name for name in names_in(path) if f"{name}.".startswith(sisters)], path


@pytest.mark.parametrize("system", SYSTEMS)
def test_simulators_share_no_code_with_solvers(root: Path, system: str) -> None:
    stages = tuple(f"locatk.core.{system}.{stage}." for stage in SOLVER_STAGES)
    paths = sorted((root / "core" / system / "simulation").glob("*.py"))
    assert len(paths) > 3
    for path in paths:
        assert not [name for name in names_in(path) if f"{name}.".startswith(stages)], path


def test_every_package_is_installed(root: Path) -> None:
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    installed = set(settings["tool"]["setuptools"]["packages"])
    folders = {path.parent for layer in LAYERS for path in (root / layer).rglob("*.py")}
    # `locatk` itself is the folder formats/root.
    assert settings["tool"]["setuptools"]["package-dir"]["locatk"] == "formats/root"
    names = {"locatk." + ".".join(f.relative_to(root).parts) for f in folders}
    assert installed == names - {"locatk.formats.root"} | {"locatk"}
    for folder in folders:
        assert (folder / "__init__.py").exists(), f"{folder} has no __init__.py"
