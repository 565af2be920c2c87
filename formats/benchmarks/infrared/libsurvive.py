"""A recording of libsurvive: its own calibrations, and its own poses of a tracker."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from locatk.core.errors import LocatkError
from locatk.core.evaluation import evaluate
from locatk.core.lighthouse import solve
from locatk.core.solution import Solution
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.timing import cpu_seconds
from locatk.formats.importers.libsurvive.device import read_stored_calibrations
from locatk.formats.importers.libsurvive.recording import read_libsurvive
from locatk.formats.importers.lighthouse import ImportedSession

RECORDING = "tracker-cal-attempt.rec.gz"

PRINTED = 5e-7
"""Half of the last of six decimals that libsurvive stores."""

SETTLED_S = 10.0
"""libsurvive's first seconds, in which its reference settles from 40 mm away."""

ROWS = {
    "libsurvive: parameters that differ": "of 56",
    "libsurvive: position": "mm",
    "libsurvive: orientation": "deg",
}


def figures(data: Path) -> list[Figure]:
    """Figures of the published recording."""
    path = data / "lighthouse" / "libsurvive" / RECORDING
    try:
        session = read_libsurvive([path], stations=True)
        return [_calibrations(session, path), *_poses(session), *_times(session, path)]
    except (LocatkError, OSError) as error:
        return [Figure(n, None, unit, f"not measured: {error}") for n, unit in ROWS.items()]


def _calibrations(session: ImportedSession, path: Path) -> Figure:
    stored = read_stored_calibrations(path.with_name(path.name + ".json"))
    differ = 0
    for station in session.stations:
        known = None if station.id is None else stored.get(station.id)
        if known is None or station.calibration is None:
            differ += 14
        else:
            off = np.abs(known.sweeps - station.calibration.sweeps)
            differ += int(np.count_nonzero(off > PRINTED))
    frames = sum(station.frames for station in session.stations)
    return Figure(
        "libsurvive: parameters that differ",
        float(differ),
        "of 56",
        f"of {len(session.stations)} stations, from {frames} frames of slow bits with a right "
        "CRC-32, against those that libsurvive stored (six decimals)",
        0.0,
        peer="libsurvive's own file",
    )


def _poses(session: ImportedSession) -> list[Figure]:
    """Against the recorded reference, in the recorded stations, without any alignment."""
    solution = solve(session.sweeps, session.scene, receivers=session.receivers)
    pairs = [(e, t) for e in solution.trajectories for t in session.truth if e.device == t.device]
    found = evaluate(pairs)
    where, turned = 1e3 * found.errors, found.rotation_errors_deg
    start = min(t.time_ns[0] for t in session.truth)
    late = found.time_ns - start > SETTLED_S * 1e9
    how = (
        f"{found.n} full poses of a tracker with 22 photodiodes, which stands still, in the "
        "recorded stations with their factory calibrations from the same recording, no alignment, "
        "against the recorded reference (libsurvive's own estimate; nothing was fitted to it): mean"
    )
    return [
        Figure("libsurvive: position", float(np.mean(where)), "mm", how, 5.0),
        Figure("libsurvive: position, 95 %", float(np.percentile(where, 95)), "mm", "the same"),
        Figure("libsurvive: orientation", float(np.nanmean(turned)), "deg", how, 0.5),
        Figure("libsurvive: orientation, 95 %", float(np.nanpercentile(turned, 95)), "deg",
               "the same"),
        Figure("libsurvive: position, largest after 10 s", float(np.max(where[late])), "mm",
               "the same, without the seconds in which the reference itself settles"),
        _switches(solution),
    ]  # fmt: skip


def _switches(solution: Solution) -> Figure:
    """How far poses move when a station is hidden."""
    checks = solution.facts.verification.stations
    return Figure(
        "libsurvive: jump when a station is hidden, 95 %",
        1e3 * max(check.jump_95_m for check in checks),
        "mm",
        f"largest of {len(checks)} stations left out in turn; users of peers report 50 to 100 mm",
        peer="users of Crazyflies",
        peer_value=50.0,
    )


def _times(session: ImportedSession, path: Path) -> list[Figure]:
    read = cpu_seconds(lambda: read_libsurvive([path]), 2)
    solved = cpu_seconds(
        lambda: solve(session.sweeps, session.scene, receivers=session.receivers), 2
    )
    return [
        Figure("libsurvive: 61 s recording read", read, "s",
               f"{len(session.sweeps):,} sweeps, processor time, best of 2"),
        Figure("libsurvive: poses of 61 s", solved, "s", "solve() in known stations, best of 2"),
    ]  # fmt: skip
