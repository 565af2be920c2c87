"""Figures of the dots without a camera: the codec, and printed sheets."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from reportlab.pdfgen.canvas import Canvas

from locatk.core.dots.codec import (
    DOT_DIRECTIONS,
    MAIN_SEQUENCE,
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    Codec,
    codec,
)
from locatk.core.dots.codec.lookup import rotate_symbols
from locatk.core.dots.drawing import layout
from locatk.core.dots.identification.decoding import (
    MIN_CONFIDENCE,
    DecodedWindows,
    identify_windows,
)
from locatk.core.dots.sheet import Manifest
from locatk.core.paper_sizes import paper_size
from locatk.formats.benchmarks.dots.rasterised_sheets import rasteriser_figures
from locatk.formats.benchmarks.figures import Duration, Figure
from locatk.formats.benchmarks.timing import (
    FIRST_SEED,
    measure_single_threaded,
    peak_memory_mb,
    time_call,
)
from locatk.formats.printing import pattern

SHEET_ORIGIN = (SECTION_LENGTH // 2, SECTION_LENGTH // 4)
WINDOW_DOTS = 8
DECODED_WINDOWS = 20_000
FLIPPED_WINDOWS = 2000
"""Windows with wrong bits, or of random bits, for each rate."""

RASTER_WINDOWS = 1000
"""Windows decoded from the raster of each paper."""

SOFT_BIT_NATS = 4.0
"""Log-likelihood ratio of each bit of a symbol; 1.8 % of bits with this ratio are wrong."""

MICRODOTS = "py-microdots"
MICRODOTS_PERCENT = {1: (44.0, 43.0), 2: (19.0, 55.0), 4: (2.7, 56.0)}
"""Wrong bits of 128, and the correct and the silently wrong results of py-microdots in percent."""

GREY_ROUNDING = 5
"""Grey values by which pdfium rounds: some white pixels have 254."""

PRINT_TARGETS = {"A4": (0.15, 170.0), "A0": (2.0, 2700.0)}
"""Paper to targets of seconds and kB; the masks of the dots alone have 150 and 2550 kB."""

REPORTLAB = "reportlab, a circle a dot"
REPORTLAB_DOTS = 5000
"""Circles that are timed; their duration and size are proportional to the number."""


def default_sheet(paper: str) -> Manifest:
    """Return a sheet with the defaults of ``locatk print pattern``."""
    raster = layout.snap(0.508, None, 300)
    _, size_mm = paper_size(paper)
    page = layout.lay_out(size_mm, 5.0, raster)
    return layout.manifest(raster, page.sheets(paper, SHEET_ORIGIN), "anoto")


# ---- codec


def codec_figures() -> list[Figure]:
    """Encode a sheet, and decode windows with and without wrong bits."""
    table, size = codec("anoto"), default_sheet("A0").sheets[0].size
    rng = np.random.default_rng(FIRST_SEED)
    truth, symbols = random_windows(table, DECODED_WINDOWS, rng)
    correct = is_correct(identify_windows(*soft_bits(symbols), table, other_codec_odds=0), truth)
    rows = [
        Figure("A0 encoded", None, "s",
               f"{size[0]} x {size[1]} dots in the middle of the plane, processor time, best of 5",
               0.2, peer=f"{MICRODOTS}, at its origin 0", peer_value=0.306, workload="numpy"
               ).timed(time_call(lambda: table.symbols(SHEET_ORIGIN, size))),
        measure_single_threaded(
            Figure("8x8 window decoded", None, "us",
                   f"identify_windows() of {DECODED_WINDOWS} windows, any position, section and "
                   "rotation, processor time of one thread", 5.0,
                   peer=f"{MICRODOTS}, 6x6 of it, no turn", peer_value=150.0, workload="numpy"),
            f"dots.printing.time_decoding({DECODED_WINDOWS})", 1e6 / DECODED_WINDOWS),
        Figure("8x8 windows: right", 100 * float(correct.mean()), "%",
               f"{DECODED_WINDOWS} windows without a wrong bit; any position, section and rotation",
               100.0, "higher", f"{MICRODOTS}, libdots' digits", 96.1),
    ]  # fmt: skip
    truth, symbols = truth[:FLIPPED_WINDOWS], symbols[:FLIPPED_WINDOWS]
    bits = 2 * WINDOW_DOTS * WINDOW_DOTS
    for count, peer_percent in MICRODOTS_PERCENT.items():
        order = rng.random((FLIPPED_WINDOWS, bits)).argsort(axis=1)
        name = f"8x8 windows, {count} wrong bit{'s' * (count > 1)}"
        rows += _flipped_rows(name, truth, symbols, order < count, peer_percent)
    flips = rng.random((FLIPPED_WINDOWS, bits)) < 1 / (1 + math.exp(SOFT_BIT_NATS))
    rows += _flipped_rows("8x8 windows, 1.8 % of bits wrong", truth, symbols, flips)
    for side in (WINDOW_DOTS, 16):
        random = rng.integers(0, 4, (FLIPPED_WINDOWS, side, side)).astype(np.uint8)
        accepted = identify_windows(*soft_bits(random), table).confidence >= MIN_CONFIDENCE
        rows.append(
            Figure(f"random bits, {side}x{side}: accepted", 100 * float(accepted.mean()), "%",
                   f"{FLIPPED_WINDOWS} windows of random symbols", 0.1,
                   peer=f"{MICRODOTS}, 6x6", peer_value=18.0)
        )  # fmt: skip
    return rows


def time_decoding(windows: int) -> Duration:
    """Time the identification of windows in one call."""
    table = codec("anoto")
    _, symbols = random_windows(table, windows, np.random.default_rng(FIRST_SEED))
    bits = soft_bits(symbols)
    return time_call(lambda: identify_windows(*bits, table, other_codec_odds=0))


def _flipped_rows(
    name: str,
    truth: NDArray[np.int64],
    symbols: NDArray[np.uint8],
    flipped: NDArray[np.bool_],
    peer_percent: tuple[float | None, float | None] = (None, None),
) -> list[Figure]:
    """Decode windows with inverted bits (mask (n, 128)), all of equal likelihood ratio."""
    signs = np.where(flipped, -1, 1).astype(np.float32).reshape(-1, 2, WINDOW_DOTS, WINDOW_DOTS)
    column, row = soft_bits(symbols)
    decoded = identify_windows(
        column * signs[:, 0], row * signs[:, 1], codec("anoto"), other_codec_odds=0
    )
    accepted = decoded.confidence >= MIN_CONFIDENCE
    correct = is_correct(decoded, truth)
    n_correct, n_wrong = int((correct & accepted).sum()), int((~correct & accepted).sum())
    n_accepted = n_correct + n_wrong
    peer = None if peer_percent[0] is None else MICRODOTS
    return [
        Figure(f"{name}: right", 100 * n_correct / len(truth), "%",
               f"and accepted, of {len(truth)}; all bits have the same likelihood ratio",
               None, "higher", peer, peer_percent[0]),
        Figure(f"{name}: wrong among accepted", 100 * n_wrong / max(n_accepted, 1), "%",
               f"{n_wrong} of {n_accepted}", 0.1, "lower",
               peer and f"{peer}, of all", peer_percent[1]),
    ]  # fmt: skip


def random_windows(
    table: Codec, n: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return random windows of the pattern.

    Returns
    -------
    truth : (n, 3) ndarray
        x, y and quarter turns.
    symbols : (n, 8, 8) ndarray
        Symbols in the frame of the camera.
    """
    offset = np.arange(WINDOW_DOTS)
    x, y = rng.integers(0, SECTION_LENGTH - WINDOW_DOTS, (2, n))
    u, v = rng.integers(0, MAIN_SEQUENCE_LENGTH, (2, n))
    rotation = rng.integers(0, 4, n)
    columns = table.phases(x[:, None] + offset) + u[:, None]
    rows = table.phases(y[:, None] + offset) + v[:, None]
    down, right = (y[:, None] + offset)[:, :, None], (x[:, None] + offset)[:, None, :]
    printed = MAIN_SEQUENCE[(columns[:, None, :] + down) % MAIN_SEQUENCE_LENGTH]
    printed = printed + 2 * MAIN_SEQUENCE[(rows[:, :, None] + right) % MAIN_SEQUENCE_LENGTH]
    symbols = np.empty_like(printed)
    for quarter in range(4):
        symbols[rotation == quarter] = rotate_symbols(printed[rotation == quarter], quarter)
    return np.stack([x, y, rotation], axis=1), symbols


def soft_bits(symbols: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the column and row bits of symbols as log-likelihood ratios of equal magnitude."""
    column, row = (
        np.where(bits > 0, SOFT_BIT_NATS, -SOFT_BIT_NATS).astype(np.float32)
        for bits in (symbols & 1, symbols >> 1)
    )
    return column, row


def is_correct(decoded: DecodedWindows, truth: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of the windows with the position and rotation of ``truth`` (n, 3)."""
    estimate = np.stack([decoded.x, decoded.y, decoded.rotation], axis=1)
    return (estimate == truth).all(axis=1)


# ---- print


def print_figures() -> list[Figure]:
    """Measure duration, size and memory of PDFs, and decode their raster."""
    rows: list[Figure] = []
    circle_s, circle_kb = measure_reportlab(REPORTLAB_DOTS)
    for paper, (target_s, target_kb) in PRINT_TARGETS.items():
        manifest = default_sheet(paper)
        pdf = pattern.render(manifest)
        dots = math.prod(manifest.sheets[0].size)
        peer_how = f"; the peer in the same run, from {REPORTLAB_DOTS:,} dots"
        rows += [
            Figure(f"{paper} printed", None, "s",
                   f"PDF of {dots:,} dots, processor time, best of 3{peer_how}", target_s,
                   peer=REPORTLAB, peer_value=circle_s * dots, workload="numpy"
                   ).timed(time_call(partial(pattern.render, manifest), 3)),
            Figure(f"{paper} printed: size", len(pdf) / 1e3, "kB", f"the same PDF{peer_how}",
                   target_kb, peer=REPORTLAB, peer_value=circle_kb * dots),
            *raster_figures(paper, manifest, pdf),
        ]  # fmt: skip
    how = "largest of a process of its own; {0:.0f} MB of it before printing"
    memory = Figure("A0 printed: memory", None, "MB", how, 300.0)
    rows.append(measure_single_threaded(memory, "dots.printing.measure_memory()"))
    return rows + rasteriser_figures()


def measure_reportlab(dots: int) -> tuple[float, float]:
    """Return the duration [s] and the size [kB] of a dot that reportlab draws as a circle."""

    def render() -> bytes:
        stream = io.BytesIO()
        canvas = Canvas(stream, pageCompression=1)
        for k in range(dots):
            canvas.circle(1.44 * (k % 400), 1.44 * (k // 400), 0.12, stroke=0, fill=1)
        canvas.save()
        return stream.getvalue()

    return time_call(render, 3).seconds / dots, len(render()) / 1e3 / dots


def measure_memory() -> tuple[float, float]:
    """Return the largest memory [MB] of this process before and after printing A0."""
    manifest = default_sheet("A0")
    before_mb = peak_memory_mb()
    pattern.render(manifest)
    return before_mb, peak_memory_mb()


def raster_figures(paper: str, manifest: Manifest, pdf: bytes) -> list[Figure]:
    """Rasterize a PDF at 300 dpi by an independent renderer, check its dots and decode windows."""
    declared = (
        Figure(f"{paper} at 300 dpi: dots of one black pixel", None, "%",
               "pdfium's raster: one black pixel in each square of a pitch, at the position of "
               "its symbol, and no other ink", 100.0, "higher"),
        Figure(f"{paper} at 300 dpi: windows right", None, "%",
               f"{RASTER_WINDOWS} random 8x8 windows of that raster, correct and accepted",
               100.0, "higher"),
    )  # fmt: skip
    try:
        import pypdfium2  # optional: part of locatk[test]
    except ImportError:
        reason = "pypdfium2 is not installed (it comes with locatk[test])"
        return [figure.missing(reason) for figure in declared]
    rendered = pypdfium2.PdfDocument(pdf)[0].render(scale=300 / 72, grayscale=True).to_numpy()
    grey = rendered.reshape(rendered.shape[:2])
    is_black, has_ink = grey <= int(grey.min()) + GREY_ROUNDING, grey < 255 - GREY_ROUNDING
    page = layout.pixels(manifest, 0)
    (columns, rows), pitch, (x, y) = page.size, page.raster.pitch, page.first
    candidates = np.stack(
        [
            is_black[y + dy :: pitch, x + dx :: pitch][:rows, :columns]
            for dx, dy in (page.raster.offset * DOT_DIRECTIONS.astype(int)).tolist()
        ]
    )
    # Each square of one pitch around a grid point contains no other ink than its dot.
    top, left = y - pitch // 2, x - pitch // 2
    squares = has_ink[top : top + rows * pitch, left : left + columns * pitch]
    ink_pixels = squares.reshape(rows, pitch, columns, pitch).sum(axis=(1, 3))
    sheet = manifest.sheets[0]
    symbols = codec(manifest.codec).symbols(sheet.origin, (columns, rows))
    has_dot = np.take_along_axis(candidates, symbols[None].astype(np.intp), axis=0)[0]
    dots_percent = 100 * float((has_dot & (ink_pixels == 1)).mean())

    read = candidates.argmax(axis=0).astype(np.uint8)
    rng = np.random.default_rng(FIRST_SEED + 1)
    corners = rng.integers(
        0, (columns - WINDOW_DOTS + 1, rows - WINDOW_DOTS + 1), (RASTER_WINDOWS, 2)
    )
    windows = np.stack([read[y:, x:][:WINDOW_DOTS, :WINDOW_DOTS] for x, y in corners])
    decoded = identify_windows(*soft_bits(windows), codec(manifest.codec), other_codec_odds=0)
    truth = np.c_[corners + sheet.origin, np.zeros(len(corners), np.int64)]
    correct = is_correct(decoded, truth) & (decoded.confidence >= MIN_CONFIDENCE)
    return [
        replace(declared[0], value=dots_percent),
        replace(declared[1], value=100 * float(correct.mean())),
    ]
