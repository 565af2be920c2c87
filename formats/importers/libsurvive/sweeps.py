"""Sweeps that one device of a libsurvive recording heard: when, of which turn and plane."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.demodulation.tracker_syncs import TrackerRotor, fit_rotor
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.formats.importers.libsurvive.clock import Run, runs
from locatk.formats.importers.libsurvive.lines import Columns, Recording

Rows = NDArray[np.int64]
Array = NDArray[np.float64]

EITHER_PLANE = (0.41, 0.59)
"""Turns at which a sweep can be of both planes: one looks ahead at a third of a turn, the
other at two thirds, and each is seen up to a quarter of a turn before and after."""

APART = 0.125
"""The planes pass a device further apart than this, in turns."""

RECENT = 50
"""Rotations, a second, within which a device does not move from one plane to the other."""

MANY = 0.1
"""A share of wrong syncs above this is told."""


@dataclass
class HeardSweeps:
    """What one device heard.

    Attributes
    ----------
    row : (n,) int64 ndarray
        Of each sweep that is kept, among the recording's sweeps.
    time_ns : (n,) int64 ndarray
        By the host's clock.
    turn : (n,) float64 ndarray
        Since the rotor's zero, 0 to 1.
    bit : (n,) int64 ndarray
        Slow bit of the rotation, -1 where it is not known.
    plane : (n,) int64 ndarray
        0, 1, or -1 where it can be both.
    rotors : dict of int to list of TrackerRotor
        By channel (from 0), one a run of the device's counter.
    warnings : list of str
    unplaced : int
        Lines whose timecode does not fit their time.
    rotorless : int
        Sweeps without a sync near.
    repaired : int
        Timecodes whose upper bits were put right.
    lag_s, ppm : float
        How late lines are, and how much faster than the host's the device's clock runs.
    """

    row: Rows
    time_ns: Rows
    turn: Array
    bit: Rows
    plane: Rows
    rotors: dict[int, list[TrackerRotor]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    unplaced: int = 0
    rotorless: int = 0
    repaired: int = 0
    lag_s: float = 0.0
    ppm: float = 0.0


def hear(recording: Recording, device: int) -> HeardSweeps:
    """Times, turns and planes of the sweeps of ``recording.devices[device]``."""
    rows = np.flatnonzero(recording.sweeps.device == device)
    sweeps = recording.sweeps.take(rows)
    syncs = recording.syncs.take(recording.syncs.device == device)
    name = recording.devices[device]
    heard = HeardSweeps(rows[:0], rows[:0], np.zeros(0), rows[:0], rows[:0])
    found = runs(
        np.concatenate([syncs.host_s, sweeps.host_s]),
        np.concatenate([syncs.timecode, sweeps.timecode]),
    )
    heard.unplaced = len(syncs) + len(rows) - sum(len(run.index) for run in found)
    if len(found) > 1:
        heard.warnings.append(f"the counter of {name} started again {len(found) - 1} times")
    parts = [_hear_run(run, syncs, sweeps, rows, name, heard) for run in found]
    if parts:
        heard.row, heard.time_ns, heard.bit, heard.plane = (
            np.concatenate([part[k] for part, _ in parts]) for k in range(4)
        )
        heard.turn = np.concatenate([turn for _, turn in parts])
    return heard


def _hear_run(
    run: Run, syncs: Columns, sweeps: Columns, rows: Rows, name: str, heard: HeardSweeps
) -> tuple[tuple[Rows, Rows, Rows, Rows], Array]:
    """Row, time, bit and plane, and turn, of the sweeps of one run of the counter."""
    of_sync = run.index < len(syncs)
    sync = syncs.take(run.index[of_sync])
    sync_tick = run.tick[of_sync].astype(np.float64)
    chosen = run.index[~of_sync] - len(syncs)
    sweep = sweeps.take(chosen)
    # Sweeps are timed at 96 MHz: the flag is the half tick.
    tick = run.tick[~of_sync] + 0.5 * sweep.flag
    n = len(sweep)
    turn, bit, plane = np.full(n, np.nan), np.full(n, UNKNOWN), np.full(n, UNKNOWN)
    for channel in np.unique(sync.channel).tolist():
        ours = sync.channel == channel
        rotor = fit_rotor(sync_tick[ours], sync.flag[ours], float(period_ticks(channel + 1)))
        syncs_heard = int(np.count_nonzero(ours))
        if rotor is None:
            heard.warnings.append(
                f"channel {channel + 1}: the {syncs_heard} syncs that {name} heard are of no rotor"
            )
            continue
        heard.rotors.setdefault(channel, []).append(rotor)
        if rotor.rejected > MANY * syncs_heard:
            heard.warnings.append(
                f"channel {channel + 1}: {rotor.rejected} of {syncs_heard} syncs that {name} "
                "heard do not fit one rotor; is there a second station on it?"
            )
        here = np.flatnonzero(sweep.channel == channel)
        turn[here], bit[here] = rotor.phase_and_bit(tick[here])
        plane[here] = planes(turn[here], tick[here], rotor.period_tick)
    kept = np.isfinite(turn)
    heard.rotorless += n - int(np.count_nonzero(kept))
    heard.repaired += run.repaired
    heard.lag_s, heard.ppm = run.lag_s, (1 / run.rate - 1) * 1e6
    told = (rows[chosen][kept], run.host_ns(tick)[kept], bit[kept], plane[kept])
    return told, turn[kept]


def planes(turn: Array, tick: Array, period: float) -> Rows:
    """Plane of each sweep of one channel: 0, 1, or -1 where it can be both.

    Near the middle of the turn other sweeps tell: a device is small and slow, so that its
    photodiodes meet a plane where they met it lately, and the other plane an eighth of a turn
    or more away.

    Parameters
    ----------
    turn : (n,) float64 ndarray
        0 to 1, or ``nan``.
    tick : (n,) float64 ndarray
    period : float
        Of the rotor, in ticks.
    """
    plane = (turn > 0.5).astype(np.int64)
    low, high = EITHER_PLANE
    either = np.flatnonzero((turn > low) & (turn < high))
    if not len(either):
        return plane
    plane[either] = UNKNOWN
    meets = np.ones((len(either), 2), bool)
    for k in (0, 1):
        sure = np.flatnonzero((plane == k) & np.isfinite(turn))
        sure = sure[np.argsort(tick[sure], kind="stable")]
        if not len(sure):
            continue
        after = np.minimum(np.searchsorted(tick[sure], tick[either]), len(sure) - 1)
        nearest = np.full(len(either), np.inf)
        for other in (sure[np.maximum(after - 1, 0)], sure[after]):
            recent = np.abs(tick[other] - tick[either]) < RECENT * period
            apart = np.abs(turn[other] - turn[either])
            nearest = np.minimum(nearest, np.where(recent, apart, np.inf))
        # Of a plane that was not seen lately nothing is known.
        meets[:, k] = (nearest < APART / 2) | np.isinf(nearest)
    one = meets[:, 0] != meets[:, 1]
    plane[either[one]] = meets[one, 1]
    return plane
