"""Captures of infrared light by Saleae's logic analysers, imported as sweeps.

=====================  ==============================================================
file                   recognised by
=====================  ==============================================================
capture (``.sal``)     zip archive: :mod:`locatk.formats.importers.saleae.logic2`
binary export          ``<SALEAE>``: the same module
CSV export             header ``Time [s], ...`` of Logic 1 and 2:
                       :mod:`locatk.formats.importers.saleae.csv_export`
=====================  ==============================================================

The lines that carry light are detected from their edges, unless the user names them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from locatk.core.lighthouse.published.light_decoding import decode_recording
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, Edges, StationReport, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.formats.files import read_head
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.importers.saleae.csv_export import read_csv_export
from locatk.formats.importers.saleae.digital_lines import (
    MIN_RATE_HZ,
    DigitalLine,
    RunStatistics,
    estimate_resolution,
)
from locatk.formats.importers.saleae.logic2 import MAGIC, read_binary, read_capture_file

METHODS = ("soft", "paper")

REJECTION_REASONS = {
    "burst_off_rotor": "disagree with their rotor",
    "burst_of_doubled_channel": "are of a channel on which two stations send",
    "burst_not_read": "were not decoded",
}
"""Reason why a burst gave no sweep, as the end of a sentence."""

MIN_RESOLUTION_RUNS = 100
"""Runs in bursts that show the sampling rate of a file without one."""

MIN_RATE_FRACTION = 0.999
"""Tolerance of the smallest sampling rate, for its estimation from rounded times."""

MIN_DECODED_FRACTION = 0.5
"""Fraction of decoded bursts below which the published method gives a warning."""

MAX_LISTED_LINES = 16

ZIP_MAGICS = (b"PK\x03\x04", b"PK\x05\x06")


def read_saleae(
    paths: Sequence[Path],
    *,
    channels: Sequence[int] = (),
    method: str = "soft",
    device: str = "photodiode",
) -> ImportedSession:
    """Import a capture of the data lines of photodiodes as sweeps.

    Parameters
    ----------
    paths : sequence of path
        One capture, whose lines share a clock.
    channels : sequence of int, optional
        Channels of the analyser, in order of the photodiodes. [default: those with light]
    method : str
        ``"soft"``: soft decisions on whole bursts, verified by the rotors. ``"paper"``: the
        published method.
    device : str
        Name of the device in the session.

    Raises
    ------
    MissingDataError, FormatError, InputError
        See :func:`read_capture`; also if the capture has no light of a base station.
    """
    if len(paths) != 1:
        raise InputError("several captures have no common clock", hint="Import one by one")
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}", hint=f"Choose {' or '.join(METHODS)}")
    capture = read_capture(Path(paths[0]), channels)
    try:
        if method == "paper":
            return _decode_as_published(capture, device)
        return _demodulate(capture, device)
    except InputError as error:
        raise InputError(error.message, file=capture.file, hint=error.hint) from None


def _demodulate(capture: LightCapture, device: str) -> ImportedSession:
    """Demodulate with soft decisions, and report the rejected bursts."""
    demodulated = demodulate_recording(capture.edges)
    facts = capture.facts()
    bursts = sum(len(each.bursts) for each in demodulated.photodiodes)
    accepted = sum(int(np.count_nonzero(each.is_accepted)) for each in demodulated.photodiodes)
    edges = sum(
        int(np.count_nonzero(each.continued_burst >= 0)) for each in demodulated.photodiodes
    )
    facts["bursts"] = (
        f"{bursts:,}, of which {accepted:,} were decoded and {edges:,} are fringes of those"
    )
    facts["false polynomials"] = _false_polynomials(demodulated)
    warnings = [warning.message for warning in demodulated.warnings]
    for reason, text in REJECTION_REASONS.items():
        number = sum(each.rejected[reason] for each in demodulated.photodiodes)
        if number:
            facts[reason] = f"{number:,}"
            warnings.append(f"{number:,} of {bursts:,} bursts {text}")
    doubled = sum(each.rejected["burst_of_doubled_channel"] for each in demodulated.photodiodes)
    lost = (
        f"{doubled:,} bursts {REJECTION_REASONS['burst_of_doubled_channel']}" if doubled else None
    )
    return ImportedSession(
        _sweeps(capture, demodulated.sweeps, device),
        _scene(demodulated.stations),
        [],
        facts,
        warnings,
        stations=demodulated.stations,
        lost=lost if doubled else None,
    )


def _false_polynomials(demodulated: DemodulatedRecording) -> str:
    """Compare the bursts with the polynomial of no rotor with the number expected by chance."""
    without_rotor, certain_bursts, chance = 0, 0, 0.0
    for each in demodulated.photodiodes:
        certain = each.matches.is_certain()
        channel = channel_of(each.matches.polynomial[certain])
        certain_bursts += len(channel)
        without_rotor += int(np.count_nonzero(~np.isin(channel, list(demodulated.rotors))))
        chance += float(
            np.sum([false_match_probability(bits) for bits in each.matches.evidence_bits[certain]])
        )
    return (
        f"{without_rotor:,} of {certain_bursts:,} bursts that are certain by themselves are of a "
        f"station without a rotor; {chance:.1g} are expected by chance"
    )


def _decode_as_published(capture: LightCapture, device: str) -> ImportedSession:
    """Decode with the published method, which nothing verifies."""
    sweeps, bursts = decode_recording(capture.edges)
    facts = capture.facts()
    facts["method"] = "paper"
    facts["bursts"] = f"{bursts:,}, of which {len(sweeps):,} were decoded"
    channels, numbers = np.unique(sweeps.channel, return_counts=True)
    warnings = []
    if len(sweeps) < MIN_DECODED_FRACTION * bursts:
        warnings.append(
            f"only {len(sweeps):,} of {bursts:,} bursts were decoded, and these may be wrong: the "
            "published method knows only channels 1 to 4, and nothing verifies it"
        )
    return ImportedSession(
        _sweeps(capture, sweeps, device),
        None,
        [],
        facts,
        warnings,
        stations=tuple(
            StationReport(int(channel), sweeps=int(number))
            for channel, number in zip(channels, numbers, strict=True)
        ),
    )


def _sweeps(capture: LightCapture, decoded: DecodedSweeps, device: str) -> Sweeps:
    """Return sweeps in the time of the recorder; a capture without a date begins in 1970."""
    rate, start_ns = capture.edges[0].rate_hz, capture.edges[0].start_ns
    since_ns = np.rint(decoded.tick * (NANOSECONDS_PER_S / rate)).astype(np.int64)
    if not start_ns and len(since_ns):
        # Times before a trigger are negative, which a session cannot contain.
        start_ns = max(0, -int(since_ns.min()))
    return Sweeps(
        devices=(device,),
        time_ns=start_ns + since_ns,
        device=np.zeros(len(decoded), np.int32),
        sensor=decoded.sensor,
        channel=decoded.channel,
        polynomial=decoded.polynomial,
        sweep=decoded.plane,
        count=decoded.count,
    )


def _scene(stations: Sequence[StationReport]) -> Scene | None:
    """Return the received factory calibrations for the solver; None without any."""
    calibrated = [station for station in stations if station.calibration is not None]
    if not calibrated:
        return None
    return Scene(
        calibrations={s.channel: s.calibration for s in calibrated if s.calibration is not None},
        ids={s.channel: s.id for s in calibrated if s.id is not None},
    )


# ---- captures


@dataclass(frozen=True)
class LightCapture:
    """Light in a capture.

    Attributes
    ----------
    file : Path
    format : str
        ``saleae-capture``, ``saleae-binary`` or ``saleae-csv``.
    names : tuple of str
        Lines with light, one a photodiode.
    edges : tuple of Edges
        Edges of each of them.
    others : tuple of str
        Lines without light.
    """

    file: Path
    format: str
    names: tuple[str, ...]
    edges: tuple[Edges, ...]
    others: tuple[str, ...]

    def facts(self) -> dict[str, str]:
        """Describe the capture for the metadata of a session."""
        first = self.edges[0]
        facts = {
            "format": self.format,
            "file": self.file.name,
            "light": ", ".join(
                f"{name}: {len(edges):,} edges"
                for name, edges in zip(self.names, self.edges, strict=True)
            ),
            "resolution": f"{first.resolution_hz / 1e6:g} MHz",
            "duration": f"{max(edges.duration_s for edges in self.edges):.3f} s",
        }
        if first.start_ns:
            facts["start"] = f"{np.datetime64(first.start_ns, 'ns')}Z"
        if self.others:
            facts["left out"] = ", ".join(self.others)
        return facts


def read_light(path: Path, channels: Sequence[str | int] = ()) -> list[Edges]:
    """Read the edges of the lines that carry light, one a photodiode.

    Parameters and errors as for :func:`read_capture`.
    """
    return list(read_capture(path, channels).edges)


def read_capture(path: Path, channels: Sequence[str | int] = ()) -> LightCapture:
    """Read a capture or an export of Logic 1 or 2.

    Parameters
    ----------
    path : Path
    channels : sequence of str or int, optional
        Numbers or names of the lines of photodiodes, in order of the sensors. [default: all
        lines with light, in the order of the capture]

    Raises
    ------
    MissingDataError
        The file is missing or not readable.
    FormatError
        The file is not a capture, or is damaged.
    InputError
        A channel is missing, no line carries light, or the sampling rate is too low.
    """
    path = Path(path)
    format_name, lines = _open_capture(path)
    try:
        chosen = _find_channels(lines, channels) if channels else _find_light(lines)
        edges = tuple(_read(line) for line in chosen)
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(error.message, file=path, hint=error.hint) from None
    others = tuple(str(line) for line in lines if line not in chosen)
    return LightCapture(path, format_name, tuple(map(str, chosen)), edges, others)


def _open_capture(path: Path) -> tuple[str, list[DigitalLine]]:
    """Return the name of the format, detected from the content, and the lines."""
    start = read_head(path, len(MAGIC))
    if start.startswith(ZIP_MAGICS):
        return "saleae-capture", read_capture_file(path)
    if start == MAGIC:
        return "saleae-binary", [read_binary(path)]
    return "saleae-csv", read_csv_export(path)


# ---- choice of lines


def _find_channels(lines: list[DigitalLine], channels: Sequence[str | int]) -> list[DigitalLine]:
    """Return lines by number or name, in the order of ``channels``."""
    chosen: list[DigitalLine] = []
    for channel in channels:
        word = str(channel).strip()
        matches = [line for line in lines if word == str(line.number)]
        matches = matches or [line for line in lines if word.lower() == line.name.lower()]
        if len(matches) != 1:
            raise InputError(
                f"{'several lines' if matches else 'no line'} {word!r}",
                hint=f"The capture has {_shortened(list(map(str, lines)))}",
            )
        if matches[0] in chosen:
            raise InputError(f"channel {word!r} is named twice", hint="Name each line once")
        chosen += matches
    return chosen


def _find_light(lines: list[DigitalLine]) -> list[DigitalLine]:
    """Return the lines whose edges are those of light."""
    for line in lines:
        if line.resolution_hz:
            _check_rate(line.resolution_hz)
    statistics = [RunStatistics.of(line) for line in lines]
    with_light = [line for line, runs in zip(lines, statistics, strict=True) if runs.is_light]
    if with_light:
        return with_light
    for line, runs in zip(lines, statistics, strict=True):
        if not line.resolution_hz and runs.in_bursts > MIN_RESOLUTION_RUNS:
            _check_rate(estimate_resolution(runs.first))
    details = [f"{line}: {runs}" for line, runs in zip(lines, statistics, strict=True)]
    raise InputError(
        "no light",
        hint=f"No line has bursts of runs of 83 and 167 ns ({_shortened(details)}). To import one "
        "anyway, name it with --channel",
    )


def _check_rate(rate_hz: float) -> None:
    if rate_hz < MIN_RATE_HZ * MIN_RATE_FRACTION:
        raise InputError(
            f"sampled at {rate_hz / 1e6:.3g} MHz, too low for light of 6 Mbit/s",
            hint="Record with 24 MHz or more",
        )


def _read(line: DigitalLine) -> Edges:
    edges = line.read()
    _check_rate(edges.resolution_hz)
    return edges


def _shortened(words: list[str]) -> str:
    """Return a list in one line, shortened if it is long."""
    more = len(words) - MAX_LISTED_LINES
    return ", ".join(words[:MAX_LISTED_LINES] + ([f"and {more} more"] if more > 0 else []))
