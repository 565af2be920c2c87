"""The main commands without what only POSIX has, as on Windows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

WITHOUT_POSIX = """
import os, signal, sys

for name in ("fcntl", "termios", "pty", "tty", "resource", "pwd", "grp"):
    sys.modules[name] = None
for name in ("fork", "posix_fallocate", "sched_getaffinity", "openpty", "setsid", "statvfs"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGQUIT", "SIGALRM", "SIGUSR1", "pthread_sigmask", "setitimer"):
    if hasattr(signal, name):
        delattr(signal, name)
from locatk.cli.app import main

main()
"""


def run(folder: Path, command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_POSIX, *command.split()],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.slow
def test_main_commands_need_no_posix(tmp_path: Path) -> None:
    for command in (
        "--help",
        "simulate lighthouse --duration 3 -q -o run.mcap",
        "solve run.mcap -o solved.mcap",
        "eval solved.mcap --truth run.mcap",
        "export solved.mcap -o poses.csv",
        "info run.mcap solved.mcap",
        "print pattern -o sheet.pdf",
    ):
        done = run(tmp_path, command)
        assert done.returncode == 0, f"{command}: {done.stderr}"


@pytest.mark.slow
def test_what_needs_pseudo_terminals_says_so(tmp_path: Path) -> None:
    run(tmp_path, "simulate lighthouse --duration 3 -q -o run.mcap")
    done = run(tmp_path, "emulate run.mcap --device dotbot-gateway --link port")
    assert done.returncode == 1
    assert done.stderr.startswith("Error: no pseudo-terminals on this system. Hint: ")
    assert len(done.stderr.splitlines()) == 1
