"""A short run of the fuzzer; ``.ci/run`` runs it for minutes, with seeds of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SECONDS = os.environ.get("LOCATK_FUZZ_SECONDS")
SEED = os.environ.get("LOCATK_FUZZ_SEED", "1")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs fork and limits on memory")
def test_damaged_input_is_refused_in_one_line_or_read() -> None:
    extent = ["--seconds", SECONDS] if SECONDS else ["--cases", "1"]
    command = [sys.executable, str(Path(__file__).with_name("run.py")), "--seed", SEED, *extent]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
