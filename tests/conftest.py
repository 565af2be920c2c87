"""What tests of all layers share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

# As the command does: with two threads for small matrices a busy machine takes seven times as
# long. Before anything imports numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent


def data_folder() -> Path:
    """Folder of the published recordings, whether it is there or not."""
    return Path(os.environ.get("LOCATK_DATA") or ROOT.parent / "shared" / "data").resolve()


@pytest.fixture(scope="session")
def root() -> Path:
    """Root of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of the published recordings; the test is skipped where it is absent."""
    folder = data_folder()
    if not folder.is_dir():
        pytest.skip(f"published recordings are not in {folder} (see LOCATK_DATA)")
    return folder


@pytest.fixture
def locatk() -> Callable[..., Result]:
    """``locatk("solve", path, "-o", out)`` as a user runs it; stdout and stderr apart."""
    from locatk.cli.app import app

    def run(*args: object) -> Result:
        return CliRunner().invoke(app, [str(arg) for arg in args], prog_name="locatk")

    return run
