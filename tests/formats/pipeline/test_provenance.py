"""Origin of solutions: digests, recognition of the same solution."""

from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.pipeline import SolveRequest, provenance
from locatk.formats.sessions.solutions import write_solution

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "run.mcap"
    path.write_bytes(bytes(range(256)) * 9000)  # more than a block
    return path


def solution(poses: int = 3) -> Solution:
    times = START_NS + np.arange(poses)
    track = Trajectory.from_positions("red", "floor", times, np.ones((poses, 3)))
    return Solution("lighthouse", "bundle", (track,))


def test_source_facts_are_those_of_sha256sum(source: Path) -> None:
    facts = provenance.source_facts(source)
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    assert facts == {"source": "run.mcap", "source_bytes": "2304000", "source_sha256": digest}
    os.utime(source, (1, 1))
    (source.parent / "copy").mkdir()
    copy = Path(shutil.copy(source, source.parent / "copy"))
    assert provenance.source_facts(copy) == facts


def test_options_count_by_their_content(tmp_path: Path) -> None:
    artifact = tmp_path / "tag.toml"
    artifact.write_text("a = 1")
    digest = provenance.options_digest(SolveRequest(method="paper", artifact=artifact))
    moved = artifact.rename(tmp_path / "other.toml")
    assert provenance.options_digest(SolveRequest(method="paper", artifact=moved)) == digest
    moved.write_text("a = 2")
    changed = provenance.options_digest(SolveRequest(method="paper", artifact=moved))
    requests = (SolveRequest(), SolveRequest(method="paper"), SolveRequest(speed=0.1))
    others = [provenance.options_digest(request) for request in requests]
    assert len({digest, changed, *others}) == 5


def test_digests_of_earlier_versions_stay_valid() -> None:
    """Otherwise --resume would solve every session again."""
    request = SolveRequest("paper", speed=0.1)
    known = hashlib.sha256(b'{"method": "paper", "speed": 0.1}').hexdigest()
    assert provenance.options_digest(request) == known


def test_the_same_solution_is_known_again(source: Path, tmp_path: Path) -> None:
    facts = {**provenance.source_facts(source), "options_sha256": "0"}
    out = tmp_path / "solved.mcap"
    assert provenance.same_solution(out, facts) is None
    write_solution(out, solution(), source=source, facts=facts)
    found = provenance.same_solution(out, facts)
    assert found is not None
    assert found.poses == 3
    for name in facts:
        assert provenance.same_solution(out, {**facts, name: "other"}) is None
    assert provenance.same_solution(source, facts) is None
    whole = out.read_bytes()
    out.write_bytes(whole[:-50])
    assert provenance.same_solution(out, facts) is None


def test_only_our_own_is_replaced(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "solved.mcap"
    write_solution(out, solution(), source=source)
    assert provenance.is_replaceable(out, "run.mcap")
    assert not provenance.is_replaceable(out, "walk.mcap")
    whole = out.read_bytes()
    out.write_bytes(whole[:-50])
    assert provenance.is_replaceable(out, "run.mcap")
    out.write_bytes(b"")
    assert provenance.is_replaceable(out, "run.mcap")
    out.write_text("precious")
    assert not provenance.is_replaceable(out, "run.mcap")
    assert not provenance.is_replaceable(tmp_path / "absent", "run.mcap")


def test_the_command_has_the_names_of_options() -> None:
    @dataclass(frozen=True)
    class Request:
        grid_size: int | None = None
        artifact: Path | None = None

    command = provenance.command_line("my run.mcap", Request(3, Path("a/tag.toml")))  # type: ignore[arg-type]
    assert command == "locatk solve 'my run.mcap' --grid-size 3 --artifact tag.toml"
