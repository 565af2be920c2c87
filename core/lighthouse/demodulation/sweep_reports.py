"""Decode the factory data of base stations from recorded sweeps, by their polynomials.

A receiver that identifies the polynomial of each sweep receives the slow bit of each rotation with
it (:mod:`~locatk.core.lighthouse.demodulation.ootx`). If it reports the sweeps of nearly all
rotations, as the Lighthouse deck does, its recording contains the factory data, although the
receiver did not decode them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import (
    CHANNELS,
    TICK_HZ,
    TICKS_PER_COUNT,
    channel_of,
    period_ticks,
)
from locatk.core.lighthouse.demodulation.ootx import decode_frames
from locatk.core.lighthouse.demodulation.pipeline import (
    MAX_SLOW_BIT_GAP_ROTATIONS,
    latest_factory_data,
    vote_slow_bits,
)
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, StationReport, Sweeps
from locatk.core.solution import SolverWarning


def report_stations(sweeps: Sweeps) -> tuple[tuple[StationReport, ...], tuple[SolverWarning, ...]]:
    """Return reports on the stations whose factory data are in the polynomials of sweeps.

    Each device is decoded by itself, those with the most sweeps of a station first, until one has
    a valid frame. Stations without any are not reported.
    """
    reports: list[StationReport] = []
    warnings: list[SolverWarning] = []
    has_slow_bit = (sweeps.polynomial >= 0) & (channel_of(sweeps.polynomial) == sweeps.channel)
    for channel in np.intersect1d(sweeps.channel[has_slow_bit], CHANNELS).tolist():
        rows = np.flatnonzero(has_slow_bit & (sweeps.channel == channel))
        by_device = np.bincount(sweeps.device[rows], minlength=len(sweeps.devices))
        for device in np.argsort(-by_device, kind="stable")[: np.count_nonzero(by_device)]:
            own = rows[sweeps.device[rows] == device]
            frames = decode_frames(_slow_bits(sweeps, own, channel))
            valid_frames = [frame for frame in frames if frame.is_valid]
            data, data_warnings = latest_factory_data(channel, valid_frames)
            if data is None:
                continue
            warnings += data_warnings
            reports.append(
                StationReport(
                    channel,
                    id=data.id,
                    sweeps=len(rows),
                    calibration=data.calibration,
                    frames=len(valid_frames),
                    damaged=len(frames) - len(valid_frames),
                    acceleration=data.acceleration,
                )
            )
            break
    return tuple(reports), tuple(warnings)


def _slow_bits(sweeps: Sweeps, rows: NDArray[np.int64], channel: int) -> NDArray[np.int8]:
    """Return the slow bits of one station that one device received, one per rotation.

    Rotations are numbered from one sweep to the next. Times may therefore have errors of
    milliseconds, and drift.
    """
    period = float(period_ticks(channel))
    elapsed_ns = sweeps.time_ns[rows] - sweeps.time_ns[rows[0]]
    zero = elapsed_ns * (TICK_HZ / NANOSECONDS_PER_S) - TICKS_PER_COUNT * sweeps.count[rows]
    order = np.argsort(zero, kind="stable")
    step = np.rint(np.diff(zero[order], prepend=zero[order[0]]) / period)
    rotation = np.cumsum(np.minimum(step, MAX_SLOW_BIT_GAP_ROTATIONS)).astype(np.int64)
    return vote_slow_bits(rotation, sweeps.polynomial[rows[order]])
