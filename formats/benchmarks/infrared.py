"""Figures of ``locatk bench infrared``: sweeps and factory data from the light itself.

The captures were published by the paper's authors and by Bitcraze (``data/lighthouse/benchmarks``
and ``fpga``), the recording of a tracker by libsurvive. Correctness is checked with the rotors,
which rotate with the constancy of a crystal, with checksums, and with calibrations that another
program stored.

The captures of the authors also contain a digital line for each stage of their firmware, which is
high while the stage runs. The widths of these pulses are the times of Table III (Alvarado-Marin
et al., IEEE RA-L 2024, DOI 10.1109/LRA.2024.3405345). They describe the authors' nRF52833, not
locatk, and have no target.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.evaluation import evaluate
from locatk.core.lighthouse import lfsr, solve
from locatk.core.lighthouse.channels import POLYNOMIAL_COUNT
from locatk.core.lighthouse.demodulation.burst_validation import ValidatedBursts, match_fragments
from locatk.core.lighthouse.demodulation.identification import (
    MIN_STANDALONE_EVIDENCE_BITS,
    identify_sequences,
    read_windows,
)
from locatk.core.lighthouse.demodulation.pipeline import (
    MIN_BURST_S,
    DemodulatedRecording,
    demodulate_recording,
)
from locatk.core.lighthouse.demodulation.soft_bits import (
    MAX_SOFT_BIT,
    SoftBits,
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
from locatk.core.solution import Solution
from locatk.formats.benchmarks.figures import Duration, Figure, measure_or_explain
from locatk.formats.benchmarks.timing import (
    FIRST_SEED,
    machine_factor,
    run_single_threaded,
    time_call,
)
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.importers.libsurvive.device import read_stored_calibrations
from locatk.formats.importers.libsurvive.recording import read_libsurvive
from locatk.formats.importers.saleae.recording import read_light

Array = NDArray[np.float64]

DOTBOT = "DotBot C, its best window"
RUN_LENGTH = "plain run lengths"

STATION_POLYNOMIALS = (0, 1, 2, 3)
"""Polynomials of the two stations of the authors' captures, on channels 1 and 2."""

STATION_IDS = {1: 0x4CC60647, 2: 0x0FF22226}
PERIOD_DEVIATION_PPM = {1: -15.49, 2: -18.69}
"""Deviation of the rotation period by channel: a line through all zeros of the scored capture."""

MAX_ROTOR_RESIDUAL_S = 1e-6
"""Distance from the rotor below which a burst counts as correct."""

WINDOW_SHIFT_TICKS = -1
"""Shift of the windows with which the peer's program reads its published captures."""

SHIFTED_INDEX = 20_000
"""Shift of the index at which no light was sent, for the check of fragments."""

CAPTURES = ("demodulation_code/logic", "oneLH_2D/Logic", "twoLH_2D/Logic")

SPEED_BATCH_COPIES = 4
"""Copies of the published windows in one batch whose speed is measured."""

SPEED_REPEATS = 40
"""Repetitions of a batch, of which the fastest counts."""

FPGA_BURSTS = {"take1": (103, 103), "about_4m": (95, 31)}
"""Recording of 103 bursts to the target, and to the bursts that plain run lengths read."""

FPGA_POLYNOMIALS = (12, 13)
"""Polynomials of channel 7."""

CLEAN_WINDOW_BITS = 60
"""Bits of a window, as in the test of the DotBot firmware."""

NOISE_BURSTS = 100_000
NOISE_BURST_BITS = 150

TRACKER_RECORDING = "tracker-cal-attempt.rec.gz"

STORED_ROUNDING = 5e-7
"""Half of the last of six decimals that libsurvive stores."""

PARAMETERS_PER_STATION = 14

SETTLED_S = 10.0
"""First seconds of libsurvive's recording, in which its reference settles from 40 mm away."""


def figures(data: Path) -> list[Figure]:
    """Return all figures; ``data`` is the folder of published recordings. About a minute."""
    rows: list[Figure] = []
    for measure, declared in (
        (demodulation_figures, {"bursts decoded of 11,136": "%", "false polynomials": "%"}),
        (window_figures, {"windows of 16 us read": "%"}),
        (other_capture_figures, {"bursts decoded, oneLH_2D": "%", "bursts decoded, twoLH_2D": "%"}),
        (fpga_figures, {f"bursts read, {name}": "of 103" for name in FPGA_BURSTS}),
        (
            firmware_figures,
            {f"microcontroller, {stage.name}: mean": "us" for stage in FIRMWARE_STAGES},
        ),
    ):
        rows += explain(partial(measure, data / "lighthouse"), declared)
    return [*rows, *_identification(), *tracker_figures(data / "lighthouse"), *_speed(data)]


def explain(measure: Callable[[], list[Figure]], units: dict[str, str]) -> list[Figure]:
    """Return the figures of ``measure``; if it fails, those named in ``units`` with the reason."""
    declared = (Figure(name, None, unit, "") for name, unit in units.items())
    return measure_or_explain(measure, *declared)


def read_capture(folder: Path, name: str) -> Edges:
    """Return the light of a published capture."""
    return read_light(folder / "benchmarks" / f"{name}_analyser_capture.sal")[0]


# ---- the demodulation capture


def demodulation_figures(folder: Path) -> list[Figure]:
    recording = demodulate_recording([read_capture(folder, CAPTURES[0])])
    (bursts,) = recording.photodiodes
    is_correct = bursts.is_accepted & (np.abs(bursts.rotor_residual_s) <= MAX_ROTOR_RESIDUAL_S)
    is_fragment = bursts.continued_burst >= 0
    is_fragment[is_fragment] = is_correct[bursts.continued_burst[is_fragment]]
    n = len(bursts.bursts)
    is_certain = bursts.matches.is_certain()
    is_false = ~np.isin(bursts.matches.polynomial, STATION_POLYNOMIALS)
    wrong = is_false[bursts.is_accepted]
    how = (
        f"{n:,} bursts of more than 5 us on the data line of demodulation_code, 54 s; "
        f"{np.count_nonzero(is_correct):,} were read and are within 1 us of their rotor"
    )
    return [
        Figure("bursts decoded of 11,136", _percent(is_correct | is_fragment), "%",
               f"{how}; {np.count_nonzero(is_fragment)} more are fragments of these: their light "
               "agrees with the sequence of that sweep better than with other positions of it",
               98.5, "higher", DOTBOT, 79.6),
        Figure("bursts read by themselves", _percent(is_correct), "%", how, None, "higher",
               RUN_LENGTH, 95.4),
        Figure("false polynomials", _percent(wrong), "%",
               f"of {len(wrong):,} bursts that were read, those of stations that do not exist",
               0.05, "lower", DOTBOT, 2.2),
        Figure("false polynomials, without rotors", _percent(is_false[is_certain]), "%",
               "the same if each burst is judged by its own evidence alone", 0.05, "lower",
               DOTBOT, 2.2),
        Figure("rims taken for a wrong place", 100 * _false_fragments(bursts), "%",
               "bursts that are not read, compared with another position of the same sequence"),
        *_stations(recording),
        Figure("read of the bursts near a station's sweep", 100 * _decode_rate(recording), "%",
               "decode rate of `locatk info`, both stations", None, "higher"),
    ]  # fmt: skip


def _percent(condition: NDArray[np.bool_]) -> float:
    return 100 * float(np.mean(condition))


def _false_fragments(bursts: ValidatedBursts) -> float:
    """Return the fraction of unread bursts that agree with a position that was not sent."""
    matches = bursts.matches
    shifted = replace(matches, index=(matches.index + SHIFTED_INDEX) % lfsr.SEQUENCE_LENGTH)
    continued = match_fragments(bursts.bursts, bursts.bits, shifted, bursts.is_accepted)
    return float(np.mean(continued[~bursts.is_accepted] >= 0))


def _decode_rate(recording: DemodulatedRecording) -> float:
    sweeps = sum(station.sweeps for station in recording.stations)
    missed = sum(station.missed or 0 for station in recording.stations)
    return sweeps / (sweeps + missed)


def _stations(recording: DemodulatedRecording) -> list[Figure]:
    """Return the figures of factory data and rotation periods of both stations."""
    ids = {station.channel: station.id for station in recording.stations}
    correct = sum(ids.get(channel) == station_id for channel, station_id in STATION_IDS.items())
    frames = sum(station.frames for station in recording.stations)
    damaged = sum(station.damaged for station in recording.stations)
    rows = [
        Figure("factory data of both stations", float(correct), "of 2",
               f"ids 4cc60647 and 0ff22226, each from frames with a correct CRC-32; {frames} "
               f"frames were correct and {damaged} wrong, which were not used", 2.0, "higher",
               "DotBot C", 0.0),
    ]  # fmt: skip
    for channel, fitted_ppm in PERIOD_DEVIATION_PPM.items():
        rotor = recording.rotors[channel]
        ppm = rotor.period_deviation_ppm(recording.photodiodes[0].bursts.rate_hz)
        rows.append(
            Figure(f"period of channel {channel}, off the fitted one", abs(ppm - fitted_ppm),
                   "ppm", f"{ppm:.3f} ppm of nominal; a line through all zeros gives {fitted_ppm}",
                   0.05)
        )  # fmt: skip
    return rows


# ---- the same light, sampled as by the receiver of the DotBot


def window_figures(folder: Path) -> list[Figure]:
    windows = published_windows(folder)
    matches = read_windows(windows).matches
    is_read = matches.is_certain()
    is_false = is_read & ~np.isin(matches.polynomial, STATION_POLYNOMIALS)
    paper = decode_windows(windows)
    paper_is_read = paper.polynomial >= 0
    paper_is_false = paper_is_read & ~np.isin(paper.polynomial, STATION_POLYNOMIALS)
    how = "64 bytes at 32 MS/s, from 9 us after a burst's first edge: the peer's best window"
    return [
        Figure("windows of 16 us read", _percent(is_read), "%",
               f"{how}; each by its own evidence, of all 32 polynomials", None, "higher", DOTBOT,
               79.6),
        Figure("windows: false polynomials", _percent(is_false[is_read]), "%",
               "of those", None, "lower", DOTBOT, 2.2),
        Figure("windows read by --method paper", _percent(paper_is_read), "%",
               f"{how}; the published algorithm as implemented here", None, "higher", DOTBOT,
               79.6),
        Figure("windows, --method paper: false polynomials",
               _percent(paper_is_false[paper_is_read]), "%", "of those", None, "lower", DOTBOT,
               2.2),
    ]  # fmt: skip


# ---- other captures


def other_capture_figures(folder: Path) -> list[Figure]:
    rows = []
    for name in CAPTURES[1:]:
        (bursts,) = demodulate_recording([read_capture(folder, name)]).photodiodes
        decoded = _percent(bursts.is_accepted | (bursts.continued_burst >= 0))
        rows.append(
            Figure(f"bursts decoded, {name.split('/')[0]}", decoded, "%",
                   f"of {len(bursts.bursts):,}; only the delay of weak light was tuned on this "
                   "capture", None, "higher")
        )  # fmt: skip
    return rows


def fpga_figures(folder: Path) -> list[Figure]:
    rows = []
    for name, (target, peer_value) in FPGA_BURSTS.items():
        recording = demodulate_recording(read_light(folder / "fpga" / f"{name}.csv"))
        (bursts,) = recording.photodiodes
        is_correct = bursts.is_accepted & np.isin(bursts.matches.polynomial, FPGA_POLYNOMIALS)
        sigma_s = next(iter(recording.rotors.values())).sigma_tick / bursts.bursts.rate_hz
        rows.append(
            Figure(f"bursts read, {name}", float(np.sum(is_correct)), "of 103",
                   "Bitcraze's recording, channel 7; within 2 us of the rotor, with a scatter of "
                   f"{1e6 * sigma_s:.2f} us", target, "higher", RUN_LENGTH, peer_value)
        )  # fmt: skip
    return rows


def published_windows(folder: Path) -> NDArray[np.uint8]:
    """Return the windows (11136, 64) of the DotBot's receiver in the demodulation capture."""
    edges = read_capture(folder, CAPTURES[0])
    bursts = split_bursts(edges)
    bursts = bursts.take(bursts.duration_s > MIN_BURST_S)
    start = bursts.start_tick + round(WINDOW_START_S * edges.rate_hz) + WINDOW_SHIFT_TICKS
    return sample_windows(edges, start)


# ---- the authors' microcontroller

TABLE_III = "paper, Table III"


@dataclass(frozen=True)
class FirmwareStage:
    """Row of Table III.

    Attributes
    ----------
    name : str
    capture : str
        Folder and first word of the capture's name.
    lines : tuple of str
        Lines whose pulses, one after the other, are the stage.
    mean_us, sd_us : float
        Published mean and standard deviation; None if only the mean is given.
    """

    name: str
    capture: str
    lines: tuple[str, ...]
    mean_us: float
    sd_us: float | None = None


FIRMWARE_STAGES = (
    FirmwareStage("demodulation", "demodulation_code/logic", ("demodulate_light()",), 623.0, 3.6),
    FirmwareStage(
        "polynomial", "demodulation_code/logic", ("determine_polynomial()",), 127.0, 27.0
    ),
    FirmwareStage("LFSR index", "demodulation_code/logic", ("reverse_count_p()",), 158.0, 155.0),
    FirmwareStage(
        "position, one station",
        "oneLH_2D/Logic",
        ("count_to_camera()", "apply_homography()"),
        141.0,
    ),
    FirmwareStage(
        "position, two stations", "twoLH_2D/Logic", ("count_to_camera()", "twoLH_2D"), 144.0
    ),
)
"""Rows of Table III, with the captures and lines that hold them."""

SWEEP_STAGES = ("demodulation", "polynomial", "LFSR index")
"""Stages of every sweep, all in one capture."""

PAPER_LOAD_PERCENT = 19.0
"""Processor load of the demodulation, with every sweep of two stations (section II.B)."""


def firmware_figures(folder: Path) -> list[Figure]:
    """Return the durations of the stages of Table III."""
    rows: list[Figure] = []
    busy_us = {}
    counts = {}
    for stage in FIRMWARE_STAGES:
        path = folder / "benchmarks" / f"{stage.capture}_analyser_capture.sal"
        lines = read_light(path, stage.lines)
        widths_us = [pulse_widths_us(line) for line in lines]
        busy_us[stage.name] = float(widths_us[0].sum()) / lines[0].duration_s
        counts[stage.name] = len(widths_us[0])
        how = (
            f"{len(widths_us[0]):,} pulses of {' and '.join(stage.lines)} in the authors' capture "
            f"{stage.capture.split('/')[0]}"
        )
        rows.append(
            Figure(f"microcontroller, {stage.name}: mean",
                   sum(float(widths.mean()) for widths in widths_us), "us", how, peer=TABLE_III,
                   peer_value=stage.mean_us)
        )  # fmt: skip
        if stage.sd_us is not None:
            rows.append(
                Figure(f"microcontroller, {stage.name}: SD", float(widths_us[0].std()), "us",
                       "of the same", peer=TABLE_III, peer_value=stage.sd_us)
            )  # fmt: skip
    load = sum(busy_us[name] for name in SWEEP_STAGES)
    demodulated, indexed = counts["demodulation"], counts["LFSR index"]
    return [
        *rows,
        Figure("microcontroller: load", 1e-4 * load, "%",
               f"time of {', '.join(SWEEP_STAGES)} over the duration of the capture",
               peer="paper, II.B", peer_value=PAPER_LOAD_PERCENT),
        Figure("microcontroller: captures with an index", 100 * indexed / demodulated, "%",
               f"{indexed:,} searches for an index after {demodulated:,} demodulations; the "
               "firmware searches if it has selected a polynomial", better="higher"),
    ]  # fmt: skip


def pulse_widths_us(line: Edges) -> Array:
    """Return the durations (n,) in microseconds for which a line was high, between two edges."""
    edges_us = line.tick[0 if line.rises else 1 :] * (1e6 / line.rate_hz)
    pulses = edges_us[: len(edges_us) // 2 * 2].reshape(-1, 2)
    return np.asarray(np.diff(pulses)[:, 0])


# ---- identification, without data


def _identification() -> list[Figure]:
    wrong = sum(count_wrong_windows(polynomial) for polynomial in range(POLYNOMIAL_COUNT))
    return [
        Figure("windows of 60 clean bits told wrong", float(wrong), "windows",
               f"of {POLYNOMIAL_COUNT * lfsr.SEQUENCE_LENGTH:,}: every position of all "
               f"{POLYNOMIAL_COUNT} sequences; the peer fails for 7 of the 21 polynomials of its "
               "own test", 0.0),
        Figure("noise taken for a station", 100 * false_alarm_fraction(), "%",
               f"{NOISE_BURSTS:,} bursts of {NOISE_BURST_BITS} random bits, each by its own "
               "evidence", 0.05),
    ]  # fmt: skip


def count_wrong_windows(polynomial: int) -> int:
    """Count the windows of one sequence with a wrong polynomial or index."""
    index = np.arange(lfsr.SEQUENCE_LENGTH)
    words = lfsr.bits_at(index, polynomial, CLEAN_WINDOW_BITS)
    shift = np.arange(CLEAN_WINDOW_BITS - 1, -1, -1, dtype=np.uint64)
    is_one = (words[:, None] >> shift & np.uint64(1)) > 0
    soft_bits = np.where(is_one, MAX_SOFT_BIT, -MAX_SOFT_BIT).astype(np.int8)
    matches = identify_sequences(_as_bursts(soft_bits))
    is_correct = (matches.polynomial == polynomial) & (matches.index == index)
    return int(np.count_nonzero(~(matches.is_certain() & is_correct)))


def false_alarm_fraction() -> float:
    """Return the fraction of bursts of random bits with the evidence of a station's burst."""
    rng = np.random.default_rng(FIRST_SEED)
    sign = rng.integers(0, 2, (NOISE_BURSTS, NOISE_BURST_BITS))
    magnitude = rng.integers(0, MAX_SOFT_BIT + 1, (NOISE_BURSTS, NOISE_BURST_BITS))
    soft_bits = np.where(sign > 0, magnitude, -magnitude).astype(np.int8)
    matches = identify_sequences(_as_bursts(soft_bits))
    return float(np.mean(matches.is_certain(MIN_STANDALONE_EVIDENCE_BITS)))


def _as_bursts(soft_bits: NDArray[np.int8]) -> SoftBits:
    """Convert rows (n, bits) to n bursts."""
    n, bits = soft_bits.shape
    return SoftBits(soft_bits.ravel(), np.arange(n + 1) * bits, np.zeros(n), 1.0)


# ---- a recording of libsurvive: its calibrations, and its poses of a tracker


def tracker_figures(folder: Path) -> list[Figure]:
    path = folder / "libsurvive" / TRACKER_RECORDING
    units = {
        "libsurvive: parameters that differ": "of 56",
        "libsurvive: position": "mm",
        "libsurvive: orientation": "deg",
    }

    def measure() -> list[Figure]:
        session = read_libsurvive([path], stations=True)
        return [
            compare_calibrations(session, path),
            *_tracker_poses(session),
            *_tracker_durations(session, path),
        ]

    return explain(measure, units)


def compare_calibrations(session: ImportedSession, path: Path) -> Figure:
    """Count the decoded parameters that differ from those that libsurvive stored."""
    stored = read_stored_calibrations(path.with_name(path.name + ".json"))
    differing = 0
    for station in session.stations:
        expected = None if station.id is None else stored.get(station.id)
        if expected is None or station.calibration is None:
            differing += PARAMETERS_PER_STATION
        else:
            difference = np.abs(expected.sweeps - station.calibration.sweeps)
            differing += int(np.count_nonzero(difference > STORED_ROUNDING))
    frames = sum(station.frames for station in session.stations)
    return Figure(
        "libsurvive: parameters that differ", float(differing), "of 56",
        f"of {len(session.stations)} stations, from {frames} frames of slow bits with a correct "
        "CRC-32, against those that libsurvive stored (six decimals)", 0.0,
        peer="libsurvive's own file",
    )  # fmt: skip


def _tracker_poses(session: ImportedSession) -> list[Figure]:
    """Compare poses in the recorded stations with the recorded reference, without alignment."""
    solution = solve(session.sweeps, session.scene, receivers=session.receivers)
    pairs = [(e, t) for e in solution.trajectories for t in session.truth if e.device == t.device]
    evaluation = evaluate(pairs)
    errors_mm, errors_deg = 1e3 * evaluation.errors, evaluation.rotation_errors_deg
    start_ns = min(truth.time_ns[0] for truth in session.truth)
    is_settled = evaluation.time_ns - start_ns > SETTLED_S * 1e9
    how = (
        f"{evaluation.n} full poses of a resting tracker with 22 photodiodes, in the recorded "
        "stations with their factory calibrations from the same recording, no alignment, against "
        "the recorded reference (libsurvive's own estimate, to which nothing was fitted): mean"
    )
    return [
        Figure("libsurvive: position", float(np.mean(errors_mm)), "mm", how, 5.0),
        Figure("libsurvive: position, 95 %", float(np.percentile(errors_mm, 95)), "mm",
               "of the same poses"),
        Figure("libsurvive: orientation", float(np.nanmean(errors_deg)), "deg", how, 0.5),
        Figure("libsurvive: orientation, 95 %", float(np.nanpercentile(errors_deg, 95)), "deg",
               "of the same poses"),
        Figure("libsurvive: position, largest after 10 s", float(np.max(errors_mm[is_settled])),
               "mm", "of the same poses, without the seconds in which the reference settles"),
        _jump_without_station(solution),
    ]  # fmt: skip


def _jump_without_station(solution: Solution) -> Figure:
    stations = solution.facts.verification.stations
    return Figure(
        "libsurvive: jump when a station is hidden, 95 %",
        1e3 * max(station.jump_95_m for station in stations), "mm",
        f"largest of {len(stations)} stations left out in turn; users of peers report 50 to 100 mm",
        peer="users of Crazyflies", peer_value=50.0,
    )  # fmt: skip


def _tracker_durations(session: ImportedSession, path: Path) -> list[Figure]:
    reading = time_call(lambda: read_libsurvive([path]), 2, "Python")
    solving = time_call(
        lambda: solve(session.sweeps, session.scene, receivers=session.receivers), 2
    )
    return [
        Figure("libsurvive: 61 s recording read", None, "s",
               f"{len(session.sweeps):,} sweeps, processor time, best of 2",
               workload="Python").timed(reading),
        Figure("libsurvive: poses of 61 s", None, "s",
               "solve() in known stations, processor time, best of 2",
               workload="numpy").timed(solving),
    ]  # fmt: skip


# ---- speed


def _speed(data: Path) -> list[Figure]:
    """Time the stages in one process with one thread."""
    declared = (
        Figure("windows of 16 us to index", None, "k/s",
               "64 bytes each to polynomial and index, batches of "
               f"{11_136 * SPEED_BATCH_COPIES:,}, processor time of one thread, best of "
               f"{SPEED_REPEATS}; the peer's chain does the same for 8 polynomials",
               400.0, "higher", "DotBot C, -O3", 216.0, "numpy"),
        Figure("soft bits to index", None, "k/s",
               "the same without demodulation, all 32 polynomials", None, "higher",
               "DotBot C, -O3, 8 polynomials", 658.0, "numpy"),
        Figure("tables of all 32 sequences", None, "s", "computed once a process", 1.0,
               workload="numpy"),
        Figure("import of 54 s of light", None, "s",
               "the demodulation capture from edges in memory to sweeps and factory data",
               workload="numpy"),
    )  # fmt: skip

    def measure() -> list[Figure]:
        read_capture(data / "lighthouse", CAPTURES[0])  # reports missing data with its path
        numbers = run_single_threaded(f"infrared.time_stages({str(data)!r})")
        windows, durations = numbers[0], np.reshape(numbers[1:], (4, 2))
        amounts = (windows / 1e3, windows / 1e3, 1.0, 1.0)
        return [
            figure.timed(Duration(*duration), amount)
            for figure, duration, amount in zip(declared, durations.tolist(), amounts, strict=True)
        ]

    return measure_or_explain(measure, *declared)


def time_stages(data: str) -> list[float]:
    """Return the number of windows, and the durations of the four figures of speed."""
    factor = machine_factor("numpy")
    start = time.process_time()
    lfsr.tables()
    tables = Duration(time.process_time() - start, factor)
    folder = Path(data) / "lighthouse"
    windows = np.concatenate([published_windows(folder)] * SPEED_BATCH_COPIES)
    from_windows = time_call(lambda: read_windows(windows), SPEED_REPEATS)
    soft_bits = demodulate_bursts(split_windows(windows))
    from_soft_bits = time_call(lambda: identify_sequences(soft_bits), SPEED_REPEATS)
    edges = read_capture(folder, CAPTURES[0])
    light = time_call(lambda: demodulate_recording([edges]), 3)
    return [len(windows), *from_windows, *from_soft_bits, *tables, *light]
