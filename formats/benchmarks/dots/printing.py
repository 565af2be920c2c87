"""The figures of the dots' codec and of printing: no camera takes part in them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import (
    DOT_DIRECTIONS,
    MAIN_SEQUENCE,
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    Codec,
    codec,
)
from locatk.core.dots.codec import lookup as exact
from locatk.core.dots.drawing import layout
from locatk.core.dots.identification.decoding import (
    MIN_CONFIDENCE,
    DecodedWindows,
    identify_windows,
)
from locatk.core.dots.sheet import Manifest
from locatk.core.paper_sizes import paper_size
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.timing import SEED, cpu_seconds, measured

ORIGIN = (SECTION_LENGTH // 2, SECTION_LENGTH // 4)
WINDOW = 8
WINDOWS = 20_000
SPOILT = 2000
"""Windows with wrong bits, or of nothing but wrong bits, behind each rate."""

RASTER_WINDOWS = 1000
"""Windows that are read from each paper's raster."""

FIRMNESS = 4.0
"""Log-likelihood ratio of a bit that was read off a symbol: 1.8 % of such bits are wrong."""

MICRODOTS = "py-microdots"
FLIPS = {1: (0.44, 0.43), 2: (0.19, 0.55), 4: (0.027, 0.56)}
"""Wrong bits of 128, and the peer's shares of right and of silently wrong answers."""

FAINT = 5
"""Grey values by which pdfium rounds: white is 254 here and there."""

PRINTS = {"A4": (0.15, 70.0, 45.6, 12_500.0), "A0": (2.0, 1100.0, None, None)}
"""Paper to seconds and kB that were promised, and those of reportlab with circles."""


def page(paper: str) -> Manifest:
    """A sheet as ``locatk print pattern`` makes it by default."""
    raster = layout.snap(0.508, None, 300)
    _, size_mm = paper_size(paper)
    placed = layout.lay_out(size_mm, 5.0, raster)
    return layout.manifest(raster, placed.sheets(paper, ORIGIN), "anoto")


# ---- codec


def codec_figures() -> list[Figure]:
    """Encoding, decoding, and what wrong bits do."""
    table, size = codec("anoto"), page("A0").sheets[0].size
    seconds = cpu_seconds(lambda: table.symbols(ORIGIN, size))
    rng = np.random.default_rng(SEED)
    truth, symbols = random_windows(table, WINDOWS, rng)
    right = is_right(identify_windows(*soft(symbols), table), truth)
    rows = [
        Figure("A0 encoded", seconds, "s",
               f"{size[0]} x {size[1]} dots in the middle of the plane, best of 5", 0.2,
               peer=f"{MICRODOTS}, at its origin 0", peer_value=0.306),
        _decoding(),
        Figure("8x8 windows: right", 100 * float(right.mean()), "%",
               f"{WINDOWS} windows without a wrong bit; any place, section and turn",
               100.0, "higher", f"{MICRODOTS}, libdots' digits", 96.1),
    ]  # fmt: skip
    truth, symbols = truth[:SPOILT], symbols[:SPOILT]
    for count, (peer_right, peer_wrong) in FLIPS.items():
        order = rng.random((SPOILT, 2 * WINDOW * WINDOW)).argsort(axis=1)
        rows += _spoilt(
            f"8x8 windows, {count} wrong bit{'s' * (count > 1)}", truth, symbols, order < count,
            (100 * peer_right, 100 * peer_wrong),
        )  # fmt: skip
    lot = rng.random((SPOILT, 2 * WINDOW * WINDOW)) < 1 / (1 + math.exp(FIRMNESS))
    rows += _spoilt("8x8 windows, 1.8 % of bits wrong", truth, symbols, lot)
    for side in (WINDOW, 16):
        lots = rng.integers(0, 4, (SPOILT, side, side)).astype(np.uint8)
        accepted = identify_windows(*soft(lots), table).confidence >= MIN_CONFIDENCE
        rows.append(
            Figure(f"random bits, {side}x{side}: accepted", 100 * float(accepted.mean()), "%",
                   f"{SPOILT} windows of symbols drawn by lot", 0.1,
                   peer=f"{MICRODOTS}, 6x6", peer_value=18.0)
        )  # fmt: skip
    return rows


def decoding(windows: int) -> tuple[float]:
    """Seconds for a window."""
    table = codec("anoto")
    _, symbols = random_windows(table, windows, np.random.default_rng(SEED))
    bits = soft(symbols)
    return (cpu_seconds(lambda: identify_windows(*bits, table)) / windows,)


def _decoding() -> Figure:
    return measured(
        "8x8 window decoded", "us", f"dots.printing.decoding({WINDOWS})", 1e6,
        f"identify_windows() of {WINDOWS} windows, any place, section and turn, one thread",
        5.0, "lower", f"{MICRODOTS}, 6x6 of it, no turn", 150.0,
    )  # fmt: skip


def _spoilt(
    name: str,
    truth: NDArray[np.int64],
    symbols: NDArray[np.uint8],
    wrong: NDArray[np.bool_],
    peers: tuple[float | None, float | None] = (None, None),
) -> list[Figure]:
    """Windows of which the bits in ``wrong`` (n, 128) are turned over, all equally sure."""
    signs = np.where(wrong, -1, 1).astype(np.float32).reshape(-1, 2, WINDOW, WINDOW)
    column, row = soft(symbols)
    answer = identify_windows(column * signs[:, 0], row * signs[:, 1], codec("anoto"))
    right, accepted = is_right(answer, truth), answer.confidence >= MIN_CONFIDENCE
    good, bad = int((right & accepted).sum()), int((~right & accepted).sum())
    peer = None if peers[0] is None else MICRODOTS
    return [
        Figure(f"{name}: right", 100 * good / len(truth), "%",
               f"and accepted, of {len(truth)}; no bit looks worse than the others",
               None, "higher", peer, peers[0]),
        Figure(f"{name}: wrong among accepted", 100 * bad / max(good + bad, 1), "%",
               f"{bad} of {good + bad}", 0.1, "lower",
               peer and f"{peer}, of all", peers[1]),
    ]  # fmt: skip


def random_windows(
    table: Codec, n: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Truth (n, 3): x, y and quarter turns; and symbols (n, 8, 8) as they are seen."""
    along = np.arange(WINDOW)
    x, y = rng.integers(0, SECTION_LENGTH - WINDOW, (2, n))
    u, v = rng.integers(0, MAIN_SEQUENCE_LENGTH, (2, n))
    turns = rng.integers(0, 4, n)
    columns = table.phases(x[:, None] + along) + u[:, None]
    rows = table.phases(y[:, None] + along) + v[:, None]
    down, right = (y[:, None] + along)[:, :, None], (x[:, None] + along)[:, None, :]
    printed = MAIN_SEQUENCE[(columns[:, None, :] + down) % MAIN_SEQUENCE_LENGTH]
    printed = printed + 2 * MAIN_SEQUENCE[(rows[:, :, None] + right) % MAIN_SEQUENCE_LENGTH]
    seen = np.empty_like(printed)
    for quarter in range(4):
        seen[turns == quarter] = exact.rotate_symbols(printed[turns == quarter], quarter)
    return np.stack([x, y, turns], axis=1), seen


def soft(symbols: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row bits of symbols, all equally sure."""
    column, row = (
        np.where(bits > 0, FIRMNESS, -FIRMNESS).astype(np.float32)
        for bits in (symbols & 1, symbols >> 1)
    )
    return column, row


def is_right(answer: DecodedWindows, truth: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which answers have the place and the turn of ``truth`` (n, 3)."""
    found = np.stack([answer.x, answer.y, answer.rotation], axis=1)
    return (found == truth).all(axis=1)


# ---- print


def print_figures() -> list[Figure]:
    """Time, size and memory of PDFs, and whether their raster can be read."""
    from locatk.formats.printing import pattern

    rows: list[Figure] = []
    for paper, (seconds_target, size_target, peer_s, peer_kb) in PRINTS.items():
        sheet = page(paper)
        pdf = pattern.render(sheet)
        seconds = cpu_seconds(lambda sheet=sheet: pattern.render(sheet), 3)  # type: ignore[misc]
        columns, count = sheet.sheets[0].size
        peer = "reportlab, a circle a dot" if peer_s else None
        rows += [
            Figure(f"{paper} printed", seconds, "s", f"PDF of {columns * count:,} dots, best of 3",
                   seconds_target, peer=peer, peer_value=peer_s),
            Figure(f"{paper} printed: size", len(pdf) / 1e3, "kB", "the same PDF", size_target,
                   peer=peer, peer_value=peer_kb),
            *_raster(paper, sheet, pdf),
        ]  # fmt: skip
    how = "most of a process of its own; {0:.0f} MB of it before it prints"
    rows.append(measured("A0 printed: memory", "MB", "dots.printing.memory()", 1.0, how, 300.0))
    return rows


def memory() -> tuple[float, float]:
    """Most memory in MB that this process had before and after it printed A0."""
    from locatk.formats.printing import pattern

    manifest = page("A0")
    before = _most_memory_mb()
    pattern.render(manifest)
    return before, _most_memory_mb()


def _most_memory_mb() -> float:
    # Not getrusage: what it tells of a child begins with the memory of its parent.
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise OSError("no VmHWM in /proc/self/status")


def _raster(paper: str, sheet: Manifest, pdf: bytes) -> list[Figure]:
    """Rasterised at 300 dpi by an independent renderer: its dots, then windows of them."""
    names = (f"{paper} at 300 dpi: dots of one black pixel", f"{paper} at 300 dpi: windows right")
    try:
        import pypdfium2
    except ImportError:
        how = "not measured: pypdfium2 is not installed (it comes with locatk[test])"
        return [Figure(name, None, "%", how, 100.0, "higher") for name in names]
    rendered = pypdfium2.PdfDocument(pdf)[0].render(scale=300 / 72, grayscale=True).to_numpy()
    grey = rendered.reshape(rendered.shape[:2])
    black, touched = grey <= int(grey.min()) + FAINT, grey < 255 - FAINT
    placed = layout.pixels(sheet, 0)
    (columns, rows), pitch, (x, y) = placed.size, placed.raster.pitch, placed.first
    seen = np.stack(
        [
            black[y + dy :: pitch, x + dx :: pitch][:rows, :columns]
            for dx, dy in (placed.raster.offset * DOT_DIRECTIONS.astype(int)).tolist()
        ]
    )
    # A dot is alone in the square of one pitch about its place.
    top, left = y - pitch // 2, x - pitch // 2
    around = touched[top : top + rows * pitch, left : left + columns * pitch]
    inked = around.reshape(rows, pitch, columns, pitch).sum(axis=(1, 3))
    symbols = codec(sheet.codec).symbols(sheet.sheets[0].origin, (columns, rows))
    where_it_should = np.take_along_axis(seen, symbols[None].astype(np.intp), axis=0)[0]
    share = float((where_it_should & (inked == 1)).mean())

    read = seen.argmax(axis=0).astype(np.uint8)
    rng = np.random.default_rng(SEED + 1)
    at = rng.integers(0, (columns - WINDOW + 1, rows - WINDOW + 1), (RASTER_WINDOWS, 2))
    cut = np.stack([read[down:, right:][:WINDOW, :WINDOW] for right, down in at])
    answer = identify_windows(*soft(cut), codec(sheet.codec))
    truth = np.c_[at + sheet.sheets[0].origin, np.zeros(len(at), np.int64)]
    right = is_right(answer, truth) & (answer.confidence >= MIN_CONFIDENCE)
    return [
        Figure(names[0], 100 * share, "%",
               "pdfium's raster: one black pixel in each square of a pitch, where its symbol "
               "puts it, and no other ink", 100.0, "higher"),
        Figure(names[1], 100 * float(right.mean()), "%",
               f"{RASTER_WINDOWS} random 8x8 windows of that raster, right and accepted",
               100.0, "higher"),
    ]  # fmt: skip
