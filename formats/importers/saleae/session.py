"""A capture of infrared light as a session: sweeps, stations, factory calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from locatk.core.errors import InputError
from locatk.core.lighthouse.channels import channel_of
from locatk.core.lighthouse.demodulation import (
    DecodedSweeps,
    DemodulatedRecording,
    demodulate_recording,
    false_match_probability,
)
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, StationReport, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.formats.importers.lighthouse import ImportedSession
from locatk.formats.importers.saleae.capture import LightCapture, read_capture

METHODS = ("soft", "paper")

REASONS = {
    "burst_off_rotor": "disagree with their rotor",
    "burst_of_doubled_channel": "are of a channel on which two stations send",
    "burst_not_read": "were not read",
}
"""Why a burst gave no sweep, for people."""


def read_saleae(
    paths: Sequence[Path],
    *,
    channels: Sequence[int] = (),
    method: str = "soft",
    device: str = "photodiode",
) -> ImportedSession:
    """Read a capture of photodiodes' data lines into sweeps.

    Parameters
    ----------
    paths : sequence of path
        One capture: its lines are by one clock.
    channels : sequence of int, optional
        Of the analyser, in order of the photodiodes; else all that carry light.
    method : str
        ``"soft"``: whole bursts, judged by the rotors. ``"paper"``: the published way.
    device : str
        Name of the device in the session.

    Raises
    ------
    MissingDataError, FormatError, InputError
        See :func:`~locatk.formats.importers.saleae.capture.read_capture`; also if the capture
        has no light of a base station.
    """
    if len(paths) != 1:
        raise InputError("several captures have no common clock", hint="Import one by one")
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}", hint=f"Choose {' or '.join(METHODS)}")
    capture = read_capture(Path(paths[0]), channels)
    try:
        if method == "paper":
            return _as_paper(capture, device)
        return _session(capture, demodulate_recording(capture.edges), device)
    except InputError as error:
        raise InputError(error.message, file=capture.file, hint=error.hint) from None


def _session(
    capture: LightCapture, reception: DemodulatedRecording, device: str
) -> ImportedSession:
    facts = capture.facts()
    bursts = sum(len(reading.bursts) for reading in reception.photodiodes)
    read = sum(int(np.count_nonzero(reading.is_accepted)) for reading in reception.photodiodes)
    rims = sum(
        int(np.count_nonzero(reading.continued_burst >= 0)) for reading in reception.photodiodes
    )
    facts["bursts"] = f"{bursts:,}, of which {read:,} were read and {rims:,} are rims of those"
    facts["false polynomials"] = _false_polynomials(reception)
    warnings = [warning.message for warning in reception.warnings]
    for reason, words in REASONS.items():
        number = sum(reading.rejected[reason] for reading in reception.photodiodes)
        if number:
            facts[reason] = f"{number:,}"
            warnings.append(f"{number:,} of {bursts:,} bursts {words}")
    doubled = sum(reading.rejected["burst_of_doubled_channel"] for reading in reception.photodiodes)
    return ImportedSession(
        _sweeps(capture, reception.sweeps, device),
        _scene(reception.stations),
        [],
        facts,
        warnings,
        stations=reception.stations,
        lost=f"{doubled:,} bursts {REASONS['burst_of_doubled_channel']}" if doubled else None,
    )


def _false_polynomials(reception: DemodulatedRecording) -> str:
    """How many bursts name a station that no rotor supports, and how many by chance would."""
    strange, alone, chance = 0, 0, 0.0
    for reading in reception.photodiodes:
        certain = reading.matches.is_certain()
        channel = channel_of(reading.matches.polynomial[certain])
        alone += len(channel)
        strange += int(np.count_nonzero(~np.isin(channel, list(reception.rotors))))
        chance += float(
            np.sum([false_match_probability(e) for e in reading.matches.evidence_bits[certain]])
        )
    return (
        f"{strange:,} of {alone:,} bursts that stand on their own name a station without a rotor; "
        f"{chance:.1g} by chance"
    )


def _as_paper(capture: LightCapture, device: str) -> ImportedSession:
    from locatk.core.lighthouse.published.light_decoding import decode_recording

    caught, bursts = decode_recording(capture.edges)
    facts = capture.facts()
    facts["method"] = "paper"
    facts["bursts"] = f"{bursts:,}, of which {len(caught):,} were decoded"
    channels, numbers = np.unique(caught.channel, return_counts=True)
    warnings = []
    if len(caught) < bursts / 2:
        warnings.append(
            f"only {len(caught):,} of {bursts:,} bursts were decoded, and these may be wrong: the "
            "published way knows channels 1 to 4 only, and nothing checks it"
        )
    return ImportedSession(
        _sweeps(capture, caught, device),
        None,
        [],
        facts,
        warnings,
        stations=tuple(
            StationReport(int(channel), sweeps=int(number))
            for channel, number in zip(channels, numbers, strict=True)
        ),
    )


def _sweeps(capture: LightCapture, caught: DecodedSweeps, device: str) -> Sweeps:
    """Sweeps by the recorder's clock; a capture without a date begins in 1970."""
    rate, start_ns = capture.edges[0].rate_hz, capture.edges[0].start_ns
    since_ns = np.rint(caught.tick * (NANOSECONDS_PER_S / rate)).astype(np.int64)
    if not start_ns and len(since_ns):
        # Times before a trigger are below zero, which no session holds.
        start_ns = max(0, -int(since_ns.min()))
    return Sweeps(
        devices=(device,),
        time_ns=start_ns + since_ns,
        device=np.zeros(len(caught), np.int32),
        sensor=caught.sensor,
        channel=caught.channel,
        polynomial=caught.polynomial,
        sweep=caught.plane,
        count=caught.count,
    )


def _scene(stations: Sequence[StationReport]) -> Scene | None:
    """What the stations told of themselves, for the solver."""
    told = [station for station in stations if station.calibration is not None]
    if not told:
        return None
    return Scene(
        calibrations={s.channel: s.calibration for s in told if s.calibration is not None},
        ids={s.channel: s.id for s in told if s.id is not None},
    )
