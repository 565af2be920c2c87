"""The figures of ``locatk bench infrared``: sweeps and factory data from the light itself.

The captures are those that the paper's authors and Bitcraze published
(``data/lighthouse/benchmarks`` and ``fpga``), and a recording of libsurvive. What is right is
told by the rotors, which turn with a crystal's constancy, by checksums, and by calibrations
that another program stored.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.demodulation.burst_validation import ValidatedBursts, match_fragments
from locatk.core.lighthouse.demodulation.identification import (
    SequenceMatches,
    identify_sequences,
    read_windows,
)
from locatk.core.lighthouse.demodulation.pipeline import (
    MIN_BURST_S,
    DemodulatedRecording,
    demodulate_recording,
)
from locatk.core.lighthouse.demodulation.soft_bits import (
    demodulate_bursts,
    split_bursts,
    split_windows,
)
from locatk.core.lighthouse.published.light_decoding import (
    WINDOW_START_S,
    decode_windows,
    sample_windows,
)
from locatk.core.lighthouse.recording import Edges
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.infrared.identification import figures as place_figures
from locatk.formats.benchmarks.infrared.libsurvive import figures as survive_figures
from locatk.formats.benchmarks.infrared.microcontroller import STAGES
from locatk.formats.benchmarks.infrared.microcontroller import figures as microcontroller_figures
from locatk.formats.benchmarks.timing import alone, cpu_seconds
from locatk.formats.importers.saleae.recording import read_light

DOTBOT = "DotBot C, its best window"
RUN_LENGTH = "plain run lengths"

POLYNOMIALS = (0, 1, 2, 3)
"""Of the two stations of the published captures, on channels 1 and 2."""

IDS = {1: 0x4CC60647, 2: 0x0FF22226}
PPM = {1: -15.49, 2: -18.69}
"""Clock errors of the stations, measured in the capture that is scored."""

ROTOR_S = 1e-6

PHASE_TICKS = -1
"""With which the peer's own program reads what it is said to: its samples come a tick later."""

CAPTURES = ("demodulation_code/logic", "oneLH_2D/Logic", "twoLH_2D/Logic")

SPEED_BATCH_COPIES = 4
"""Copies of the published windows in one batch whose speed is measured."""

SPEED_REPEATS = 40
"""Repetitions of a batch, of which the fastest counts."""

FPGA = {"take1": (103, 103), "about_4m": (95, 31)}
"""Recording to what is promised of its 103 bursts, and what plain run lengths read."""


def figures(data: Path) -> list[Figure]:
    """All figures; ``data`` is the folder of published recordings. About a minute."""
    folder = data / "lighthouse"
    found: list[Figure] = []
    for measure, names in (
        (_demodulation, {"bursts decoded of 11,136": "%", "false polynomials": "%"}),
        (_windows, {"windows of 16 us read": "%"}),
        (_others, {"bursts decoded, oneLH_2D": "%", "bursts decoded, twoLH_2D": "%"}),
        (_fpga, {f"bursts read, {name}": "of 103" for name in FPGA}),
        (microcontroller_figures, {f"microcontroller, {s.name}: mean": "us" for s in STAGES}),
    ):
        found += _or_why(measure, folder, names)
    return [*found, *place_figures(), *survive_figures(data), *_speed(data)]


def _or_why(
    measure: Callable[[Path], list[Figure]], folder: Path, names: dict[str, str]
) -> list[Figure]:
    """Figures, or their names and why there is none."""
    try:
        return measure(folder)
    except (LocatkError, OSError) as error:
        return [Figure(name, None, unit, f"not measured: {error}") for name, unit in names.items()]


def capture(folder: Path, name: str) -> Edges:
    """The light of a published capture."""
    return read_light(folder / "benchmarks" / f"{name}_analyser_capture.sal")[0]


# ---- the demodulation capture


def _demodulation(folder: Path) -> list[Figure]:
    reception = demodulate_recording([capture(folder, CAPTURES[0])])
    (reading,) = reception.photodiodes
    by_itself = reading.is_accepted & (np.abs(reading.rotor_residual_s) <= ROTOR_S)
    rims = reading.continued_burst >= 0
    rims[rims] = by_itself[reading.continued_burst[rims]]
    n = len(reading.bursts)
    certain = reading.matches.is_certain()
    strange = certain & ~np.isin(reading.matches.polynomial, POLYNOMIALS)
    wrong = ~np.isin(reading.matches.polynomial[reading.is_accepted], POLYNOMIALS)
    how = (
        f"{n:,} bursts of more than 5 us on the data line of demodulation_code, 54 s; "
        f"{np.count_nonzero(by_itself):,} were read and are within 1 us of their rotor"
    )
    return [
        Figure("bursts decoded of 11,136", _percent(by_itself | rims), "%",
               f"{how}; {np.count_nonzero(rims)} more are rims of these: what is left of the "
               "light there is the sequence of that sweep rather than other places of it", 98.5,
               "higher", DOTBOT, 79.6),
        Figure("bursts read by themselves", _percent(by_itself), "%", how, None, "higher",
               RUN_LENGTH, 95.4),
        Figure("false polynomials", _percent(wrong), "%",
               f"of {len(wrong):,} bursts that were read, those of stations that are not there",
               0.05, "lower", DOTBOT, 2.2),
        Figure("false polynomials, without rotors", _percent(strange[certain]), "%",
               "the same where each burst has to stand on its own evidence", 0.05, "lower",
               DOTBOT, 2.2),
        Figure("rims taken for a wrong place", 100 * _wrong_rims(reading), "%",
               "bursts that are not read, held against another place of the same sequence", None),
        *_stations(reception),
        Figure("read of the bursts near a station's sweep", 100 * _decode_rate(reception), "%",
               "decode rate as `locatk info` tells it, both stations", None, "higher"),
    ]  # fmt: skip


def _percent(true: NDArray[np.bool_]) -> float:
    return 100 * float(np.mean(true))


def _wrong_rims(reading: ValidatedBursts) -> float:
    """Share of unread bursts that are taken for light of a place where nothing was sent."""
    m = reading.matches
    elsewhere = SequenceMatches(
        m.polynomial,
        (m.index + 20_000) % 131_071,
        m.evidence_bits,
        m.begin,
        m.end,
        m.known_bits,
        m.wrong_bits,
    )
    beside = match_fragments(reading.bursts, reading.bits, elsewhere, reading.is_accepted)
    return float(np.mean(beside[~reading.is_accepted] >= 0))


def _decode_rate(reception: DemodulatedRecording) -> float:
    sweeps = sum(station.sweeps for station in reception.stations)
    missed = sum(station.missed or 0 for station in reception.stations)
    return sweeps / (sweeps + missed)


def _stations(reception: DemodulatedRecording) -> list[Figure]:
    """Factory data and periods of both stations."""
    heard = {station.channel: station for station in reception.stations}
    right = sum(channel in heard and heard[channel].id == IDS[channel] for channel in IDS)
    frames = sum(station.frames for station in reception.stations)
    damaged = sum(station.damaged for station in reception.stations)
    rows = [
        Figure("factory data of both stations", float(right), "of 2",
               f"ids 4cc60647 and 0ff22226, each from frames with a right CRC-32; {frames} frames "
               f"were right and {damaged} wrong, which were not used", 2.0, "higher",
               "DotBot C", 0.0),
    ]  # fmt: skip
    for channel, known in PPM.items():
        rotor = reception.rotors[channel]
        ppm = rotor.period_deviation_ppm(reception.photodiodes[0].bursts.rate_hz)
        rows.append(
            Figure(f"period of channel {channel}, off the fitted one", abs(ppm - known), "ppm",
                   f"{ppm:.3f} ppm of nominal; a line through all zeros gives {known}", 0.05)
        )  # fmt: skip
    return rows


# ---- the same light as the peer's receiver samples it


def _windows(folder: Path) -> list[Figure]:
    windows = published_windows(folder)
    matches = read_windows(windows).matches
    good = matches.is_certain()
    strange = good & ~np.isin(matches.polynomial, POLYNOMIALS)
    paper = decode_windows(windows)
    read = paper.polynomial >= 0
    false = read & ~np.isin(paper.polynomial, POLYNOMIALS)
    how = "64 bytes at 32 MS/s, from 9 us after a burst's first edge: the peer's best window"
    return [
        Figure("windows of 16 us read", _percent(good), "%",
               f"{how}; each by its own evidence, of all 32 polynomials", None, "higher", DOTBOT,
               79.6),
        Figure("windows: false polynomials", _percent(strange[good]), "%",
               "of those", None, "lower", DOTBOT, 2.2),
        Figure("windows read by --method paper", _percent(read), "%",
               f"{how}; the published algorithm as we wrote it", None, "higher", DOTBOT, 79.6),
        Figure("windows, --method paper: false polynomials", _percent(false[read]),
               "%", "of those", None, "lower", DOTBOT, 2.2),
    ]  # fmt: skip


# ---- other captures


def _others(folder: Path) -> list[Figure]:
    rows = []
    for name in CAPTURES[1:]:
        reception = demodulate_recording([capture(folder, name)])
        (reading,) = reception.photodiodes
        decoded = _percent(reading.is_accepted | (reading.continued_burst >= 0))
        rows.append(
            Figure(f"bursts decoded, {name.split('/')[0]}", decoded, "%",
                   f"of {len(reading.bursts):,}; nothing was chosen by what is scored here but "
                   "the delay of weak light", None, "higher")
        )  # fmt: skip
    return rows


def _fpga(folder: Path) -> list[Figure]:
    rows = []
    for name, (target, peer) in FPGA.items():
        reception = demodulate_recording(read_light(folder / "fpga" / f"{name}.csv"))
        (reading,) = reception.photodiodes
        right = reading.is_accepted & np.isin(reading.matches.polynomial, (12, 13))
        sigma = next(iter(reception.rotors.values())).sigma_tick / reading.bursts.rate_hz
        rows.append(
            Figure(f"bursts read, {name}", float(np.sum(right)), "of 103",
                   f"Bitcraze's recording, channel 7; within 2 us of the rotor, of which they "
                   f"scatter by {1e6 * sigma:.2f} us", target, "higher", RUN_LENGTH, peer)
        )  # fmt: skip
    return rows


def published_windows(folder: Path) -> NDArray[np.uint8]:
    """The peer's windows of the demodulation capture, (11136, 64)."""
    edges = capture(folder, CAPTURES[0])
    bursts = split_bursts(edges)
    bursts = bursts.take(bursts.duration_s > MIN_BURST_S)
    start = bursts.start_tick + round(WINDOW_START_S * edges.rate_hz) + PHASE_TICKS
    return sample_windows(edges, start)


# ---- speed

SPEED_ROWS = {
    "windows of 16 us to index": "k/s",
    "soft bits to index": "k/s",
    "tables of all 32 sequences": "s",
    "import of 54 s of light": "s",
}


def _speed(data: Path) -> list[Figure]:
    """Speed of the stages, measured in a process of its own with one thread."""
    try:
        whole, index, tables, light = alone(f"infrared.suite.measure_speed({str(data)!r})")
    except (LocatkError, OSError) as error:
        return [Figure(n, None, unit, f"not measured: {error}") for n, unit in SPEED_ROWS.items()]
    return [
        Figure("windows of 16 us to index", whole / 1e3, "k/s",
               "64 bytes each to polynomial and index, batches of "
               f"{11_136 * SPEED_BATCH_COPIES:,}, processor time of one thread, best of "
               f"{SPEED_REPEATS}; the peer's chain does the same for 8 polynomials",
               400.0, "higher", "DotBot C, -O3", 216.0),
        Figure("soft bits to index", index / 1e3, "k/s",
               "the same without demodulation, all 32 polynomials", None, "higher",
               "DotBot C, -O3, 8 polynomials", 658.0),
        Figure("tables of all 32 sequences", tables, "s", "made once a process", 1.0),
        Figure("import of 54 s of light", light, "s",
               "the demodulation capture from edges in memory to sweeps and factory data", None),
    ]  # fmt: skip


def measure_speed(data: str) -> list[float]:
    """Return windows per second, soft bits per second, seconds for the tables and for a capture."""
    start = time.process_time()
    lfsr.tables()
    tables = time.process_time() - start
    folder = Path(data) / "lighthouse"
    windows = np.concatenate([published_windows(folder)] * SPEED_BATCH_COPIES)
    whole = cpu_seconds(lambda: read_windows(windows), SPEED_REPEATS)
    bits = demodulate_bursts(split_windows(windows))
    index = cpu_seconds(lambda: identify_sequences(bits), SPEED_REPEATS)
    edges = capture(folder, CAPTURES[0])
    light = cpu_seconds(lambda: demodulate_recording([edges]), 3)
    return [len(windows) / whole, len(windows) / index, tables, light]
