"""What tests of all layers share."""

from __future__ import annotations

import gc
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from click.testing import CliRunner, Result
from hypothesis import settings

# As the command does: with two threads for small matrices a busy machine takes seven times as
# long. Before anything imports numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Also if PYTHONDONTWRITEBYTECODE is set, as in many containers: without a cache, each process takes
# 12 s longer to rewrite the assertions, and each command in a process of its own is compiled again.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Little of what is made until the tests begin is garbage: thousands of searches for it are a third
# of the time that each process takes to collect the tests.
gc.disable()


# Other examples in each run; tests/fuzz looks for rare ones.
settings.register_profile("suite", max_examples=50)
settings.load_profile("suite")


def pytest_collection_finish() -> None:
    """Collect garbage of the tests only."""
    gc.freeze()
    gc.enable()


ROOT = Path(__file__).resolve().parent.parent


def data_folder() -> Path:
    """Folder of the published recordings, whether it is there or not."""
    return Path(os.environ.get("LOCATK_DATA") or ROOT.parent / "shared" / "data").resolve()


MODULES_OF_EXTRAS = {
    "ble": ("bleak",),
    "dask": ("distributed",),
    "dxf": ("ezdxf",),
    "live": ("websockets",),
    "mqtt": ("paho",),
    "pandas": ("pandas",),
    "parquet": ("pyarrow",),
    "pdf": ("pikepdf",),
    "ros": ("rosbags",),
    "s3": ("s3fs", "fsspec"),
    "yaml": ("yaml",),
    "zenoh": ("zenoh",),
}
"""Names by which the packages of each extra are imported."""


@pytest.fixture(scope="session")
def modules_of_extras() -> dict[str, tuple[str, ...]]:
    """Names by which the packages of each extra are imported."""
    return MODULES_OF_EXTRAS


@pytest.fixture
def without_extras(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that hides the packages of extras (default: all) until the test ends."""

    def hide(*extras: str) -> None:
        for extra in extras or MODULES_OF_EXTRAS:
            for name in MODULES_OF_EXTRAS[extra]:
                monkeypatch.setitem(sys.modules, name, None)
        # These import them at their top; tests before may have imported them.
        for name in ("printing.overlay", "importers.yaml_tree"):
            monkeypatch.delitem(sys.modules, f"locatk.formats.{name}", raising=False)

    return hide


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


@pytest.fixture(scope="session")
def crazyflie() -> ModuleType:
    """Module with simulated flights of a Crazyflie and a writer of its logs."""
    return _load_module("crazyflie")


@pytest.fixture
def air(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Bluetooth devices in range, in the place of those of bleak: none at first."""
    return _load_module("bluetooth_devices").install(monkeypatch)


@pytest.fixture(scope="session")
def ros_bags() -> ModuleType:
    """Module that writes bags of ROS with rosbags; the test is skipped where it is absent."""
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    return _load_module("ros_bags")


@pytest.fixture(scope="session")
def servers() -> ModuleType:
    """Module with poses, clients and a browser for sinks that are servers."""
    pytest.importorskip("websockets", reason="websockets is not installed")
    return _load_module("live_servers")


@pytest.fixture(scope="session")
def live_sessions(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Short sessions for live localization: ``live_sessions.raw("polaris")``."""
    module = _load_module("live_sessions")
    return module.LiveSessions(tmp_path_factory.mktemp("live"))


def _load_module(name: str) -> ModuleType:
    """Return a module of this folder."""
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, ROOT / "tests" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def locatk() -> Callable[..., Result]:
    """``locatk("solve", path, "-o", out)`` as a user runs it; stdout and stderr apart."""
    from locatk.cli.app import app

    def run(*args: object) -> Result:
        return CliRunner().invoke(app, [str(arg) for arg in args], prog_name="locatk")

    return run


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a file system of 9 MiB; skip the test if that is not possible."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=9m", "locatk-test", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        pytest.skip(f"no disk can be mounted: {error}")
    if mounted.returncode:
        pytest.skip(f"no disk can be mounted: {mounted.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def raw_bytes() -> Callable[..., bytes]:
    """Return ``raw_bytes(path, ...)``, which returns the received bytes in recordings.

    Their offsets must follow on from file to file. ``damaged_ok`` reads the rest of damaged files.
    """
    from locatk.formats.schemas.serial_pb2 import SerialChunk
    from locatk.formats.sessions.reader import Session

    def join(*paths: Path, topic: str = "/serial/robot", damaged_ok: bool = False) -> bytes:
        content = bytearray()
        for path in paths:
            session = Session.open(path, damaged_ok=damaged_ok)
            for _, chunk in session.decoded(topic, SerialChunk):
                assert chunk.byte_offset == len(content)
                content += chunk.data
        return bytes(content)

    return join


@pytest.fixture
def assert_one_ink() -> Callable[[Any], None]:
    """``assert_one_ink(page)``: its content, or that of a form, is in full black ink alone.

    That is the ink of this name on devices with inks, and plain black on all others.
    """

    import pikepdf

    other_colours = {"g", "G", "rg", "RG", "k", "K", "sc", "SC"}
    painting = {"Tj", "'", "f", "S", "B", "b", "Do"}

    def check(holder: Any) -> None:
        (space,) = holder.Resources.ColorSpace.values()
        assert list(map(str, space[:3])) == ["/Separation", "/Black", "/DeviceGray"]
        assert (list(space[3].C0), list(space[3].C1)) == ([1], [0])
        drawn = [(str(op), operands) for operands, op in pikepdf.parse_content_stream(holder)]
        names = [name for name, _ in drawn]
        assert not other_colours & set(names)
        tints = [operands for name, operands in drawn if name in ("scn", "SCN")]
        assert all([float(value) for value in operands] == [1] for operands in tints)
        # The ink is selected before anything is painted.
        first = next(number for number, name in enumerate(names) if name in painting)
        assert names.index("scn") < first
        assert "S" not in names or names.index("SCN") < first

    return check
