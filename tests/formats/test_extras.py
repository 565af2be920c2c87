"""Optional packages: the error names the extra, and nothing else needs them."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from locatk.core.errors import LocatkError
from locatk.formats.extras import PACKAGES, requires_extra

Modules = dict[str, tuple[str, ...]]

IMPORT_ALL = """
import importlib, pkgutil, sys
for name in sys.argv[1].split(","):
    sys.modules[name] = None
import locatk.cli, locatk.core, locatk.formats
for layer in (locatk.cli, locatk.core, locatk.formats):
    for module in pkgutil.walk_packages(layer.__path__, layer.__name__ + ".", lambda name: None):
        try:
            if not module.name.endswith(("__main__", ".generate")):
                importlib.import_module(module.name)
        except ImportError:
            print(module.name)
"""


@pytest.fixture(scope="module")
def extras(root: Path) -> dict[str, list[str]]:
    """The extras of pyproject.toml."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    return dict(project["optional-dependencies"])


def test_extras_are_those_of_the_project(
    extras: dict[str, list[str]], modules_of_extras: Modules
) -> None:
    for extra, package in PACKAGES.items():
        names = [re.split(r"[>=\[]", line)[0].lower() for line in extras[extra]]
        assert names == [package.lower()], extra
    assert set(extras) - {"all", "dev", "docs", "peers", "test"} == set(PACKAGES)
    assert set(modules_of_extras) == set(PACKAGES)


def test_all_extras_for_users_are_in_all_and_test(extras: dict[str, list[str]]) -> None:
    assert extras["all"] == [f"locatk[{','.join(sorted(PACKAGES))}]"]
    assert "locatk[all,docs]" in extras["test"]
    assert "locatk[test]" in extras["dev"]


def test_the_readme_lists_all_extras(root: Path) -> None:
    text = (root / "README.md").read_text("utf-8")
    assert set(re.findall(r"^\| `(\w+)` \| \d+ MB \|", text, re.M)) == set(PACKAGES)


def test_required_packages_are_not_extras(root: Path, extras: dict[str, list[str]]) -> None:
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    required = {re.split(r"[>=\[]", line)[0].lower() for line in project["dependencies"]}
    assert required.isdisjoint(package.lower() for package in PACKAGES.values())


@pytest.mark.parametrize("extra", PACKAGES)
def test_the_error_names_package_and_extra(
    extra: str, without_extras: Callable[..., None], modules_of_extras: Modules
) -> None:
    without_extras(extra)
    with pytest.raises(LocatkError) as error, requires_extra(extra, "this", file="a.csv"):
        importlib.import_module(modules_of_extras[extra][0])
    assert str(error.value) == f"a.csv: this needs {PACKAGES[extra]}, which is not installed"
    assert error.value.hint == f'Install it: pip install "locatk[{extra}]"'
    assert error.value.exit_status == 1


def test_a_package_that_cannot_be_loaded_is_told_from_a_missing_one() -> None:
    reason = "libz.so: no such file"
    with (
        pytest.raises(LocatkError, match=rf"which cannot be imported \({reason}\)"),
        requires_extra("dxf", "DXF"),
    ):
        raise ImportError(reason, name="ezdxf.acc")


def test_faults_of_locatk_are_not_missing_packages() -> None:
    with pytest.raises(ImportError), requires_extra("dxf", "DXF"):
        importlib.import_module("locatk.formats.nothing")


@pytest.mark.slow
def test_all_other_modules_are_imported_without_extras(modules_of_extras: Modules) -> None:
    names = ",".join(name for modules in modules_of_extras.values() for name in modules)
    done: Any = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL, names], capture_output=True, text=True, check=True
    )
    failed = set(done.stdout.split())
    assert "locatk.formats.printing.overlay" in failed
    assert "locatk.formats.importers.yaml_tree" in failed
    others = {name for name in failed if not name.startswith("locatk.formats.printing.separation.")}
    assert len(others) == 2, others
