"""Calculations of the four papers, repeated with the functions that plan.

Only sums, counts and rules are repeated here, no measurements: what the papers calculate before
they build. Each figure has the paper's number as its peer. docs/papers.md explains those that
differ (corrected or refuted). The last figure counts how many of the reproduced ones agree to the
digits that the paper prints.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from locatk.core.dots.codec.pattern import MAIN_SEQUENCE, codec
from locatk.core.dots.design.camera import design_camera
from locatk.core.dots.design.camera_materials import PAPER_FOCAL_M, camera_materials
from locatk.core.dots.design.camera_optics import window_diagonal_m
from locatk.core.dots.design.camera_sensors import SENSORS
from locatk.core.dots.design.camera_setup import CameraSetup, Lens
from locatk.core.dots.published.localization import correlate
from locatk.core.landmarks.design.analysis import analyse_landmark
from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.core.landmarks.design.localization_steps import count_localization_steps
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERN_OF, Geometry
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import POLYNOMIAL_COUNT, TICK_HZ, period_counts, period_ticks
from locatk.core.materials import BillItem, Price, total_of
from locatk.core.polaris.codec import dispatch
from locatk.core.polaris.design.planning import (
    COMPACT_SPACING_FRACTION,
    SEPARATION_FIELD_FRACTION,
    compact_spacing,
    field_width,
)
from locatk.core.polaris.published.templates import TemplateGrid, template_set
from locatk.core.polaris.tag import Tags
from locatk.formats.benchmarks.figures import Figure

DOTS = "Hostettler et al., ICRA 2016"
POLARIS = "Polaris, MobiCom 2024, DOI 10.1145/3636534.3690711"
LANDMARKS = "landmark paper, DOI 10.5772/57517"
LIGHTHOUSE = "Alvarado-Marin et al., RA-L 2024, DOI 10.1109/LRA.2024.3405345"

PITCH_M = 0.508e-3
"""Pitch of the paper's dots (II.A)."""

PAPER_PIXEL_M, PAPER_EXPOSURE_S = 0.046e-3, 1 / 7684
"""Pixel on the ground, and exposure (III.A.2)."""

EARTH_M2 = 5.101e14
"""Surface of the Earth."""

LIGHTHOUSE_STAGES_S = (623e-6, 127e-6, 158e-6)
"""Mean times of the stages of Table III: demodulation, polynomial, LFSR index."""

WINDOW_SAMPLES = 300
"""Windows of 24 bits that are compared with all other polynomials."""


class _Calculations:
    """Collects figures, and counts those that agree with the paper."""

    def __init__(self) -> None:
        self.figures: list[Figure] = []
        self.expected = self.agreeing = 0

    def add(
        self,
        name: str,
        value: float,
        paper_value: float,
        unit: str,
        how: str,
        peer: str,
        *,
        digits: float | None = 0.5,
    ) -> None:
        """Add a figure.

        ``digits`` is the largest difference that rounding explains, in the unit of the figure; None
        for a statement that docs/papers.md corrects or refutes.
        """
        if digits is not None:
            self.expected += 1
            self.agreeing += abs(value - paper_value) <= digits
        else:
            how += "; docs/papers.md explains the difference"
        self.figures.append(
            Figure(
                f"calculated: {name}", float(value), unit, how, peer=peer, peer_value=paper_value
            )
        )


def figures(data: Path) -> list[Figure]:
    """Repeat all calculations; no recordings are needed."""
    calculations = _Calculations()
    for add in (_add_dots, _add_polaris, _add_landmarks, _add_lighthouse):
        add(calculations)
    return [
        *calculations.figures,
        Figure(
            "calculated: agree with the paper",
            calculations.agreeing,
            f"of {calculations.expected}",
            "calculations above that are not corrected or refuted in docs/papers.md, to the digits "
            "that the papers print",
            target=calculations.expected,
            better="higher",
        ),
    ]


# ---- dots


def _add_dots(to: _Calculations) -> None:
    diagonal_mm = 1e3 * window_diagonal_m(8, PITCH_M)
    to.add("dots, field of 8 x 8 dots", diagonal_mm, 5.39, "mm", "III.A.3", DOTS, digits=0.005)

    sensor = next(each for each in SENSORS if each.name == "mt9v034-binned")
    magnification = sensor.pixel_m / PAPER_PIXEL_M
    setup = CameraSetup(
        sensor,
        Lens(PAPER_FOCAL_M),
        distance_m=PAPER_FOCAL_M * (1 + 1 / magnification),
        exposure_s=PAPER_EXPOSURE_S,
    )
    report = design_camera(setup)
    speed_mm_s = 1e3 * report.one_pixel_speed_mps
    how = "III.A.2, from 0.046 mm and 1/7684 s"
    to.add("dots, speed of one pixel of blur", speed_mm_s, 353, "mm/s", how, DOTS)
    rpm = report.one_pixel_yaw_rate_rps * 60 / math.tau
    how = "III.A.2: the middle of the farthest of 188 px is 93.5 px, 4.30 mm, from the centre"
    to.add("dots, rotation of one pixel of blur", rpm, 785, "rpm", how, DOTS)

    section = math.prod(len(digits) for digits in codec("anoto").digits)
    to.add("dots, positions of a section", section, 410_815_348, "", "II.A", DOTS)
    positions = (section * len(MAIN_SEQUENCE)) ** 2
    to.add("dots, positions in all", positions / 1e20, 6.7, "1e20", "II.A", DOTS, digits=0.05)
    earth = positions * PITCH_M**2 / EARTH_M2
    to.add("dots, surface of the Earth", earth, 1 / 3, "", "II.A, a third", DOTS, digits=0.05)

    price = Price(8.51, "EUR", "2016", f"{DOTS}, Table II")
    parts = [
        item
        for item in camera_materials("MT9V034", PAPER_FOCAL_M, 850e-9)
        if item.price is not None
    ]
    total = total_of([*parts, BillItem("microcontroller", 1, "PIC32MZ1024ECG064", price)])
    how = "Table II, sum of the parts"
    to.add("dots, cost of the parts", total.amount, 25.75, "EUR", how, DOTS, digits=0.005)

    for length, how in ((8, "II.B.6"), (7, "II.B.6; seven bits suffice")):
        strings = _substrings(length)
        reversed_inverted = {tuple(1 - bit for bit in string[::-1]) for string in strings}
        count = len(strings & reversed_inverted)
        name = f"dots, substrings of {length} bits that occur reversed and inverted"
        to.add(name, count, 0, "", how, DOTS)
    strings = _substrings(8)
    changed = sum(
        (*string[:bit], 1 - string[bit], *string[bit + 1 :]) in strings
        for string in strings
        for bit in range(8)
    )
    to.add("dots, substrings of 8 bits with one bit changed", changed, 0, "", "II.B.7", DOTS)
    right = 0
    lines = np.array(sorted(strings)) * 2.0 - 1.0
    phases, _ = correlate(lines, np.ones_like(lines))
    for bit in range(8):
        flipped = lines.copy()
        flipped[:, bit] *= -1
        found, _ = correlate(flipped, np.ones_like(lines))
        right += int((found == phases).sum())
    how = "II.B.7, of equal correlations the first counts"
    percent = 100 * right / (8 * len(lines))
    to.add("dots, right after a single error", percent, 36, "%", how, DOTS, digits=None)


def _substrings(length: int) -> set[tuple[int, ...]]:
    """Return the cyclic substrings of the main sequence."""
    count = len(MAIN_SEQUENCE)
    index = np.add.outer(np.arange(count), np.arange(length)) % count
    return {tuple(string) for string in MAIN_SEQUENCE[index].tolist()}


# ---- Polaris


def _add_polaris(to: _Calculations) -> None:
    for order, magnets, orientations, bits, section in (
        (3, 5, 8, 18, "7.1"),
        (3, 8, 8, 24, "Fig. 6 (c)"),
        (2, 3, 8, 9, "8.4.2"),
        (4, 8, 16, 41, "5.2.2"),
    ):
        tags = Tags(order=order, magnets=magnets, orientations=orientations)
        value = math.floor(math.log2(dispatch.capacity(tags)))
        name = f"polaris, K = {order}, M = {magnets}, P = {orientations}"
        to.add(name, value, bits, "bits", f"Eq. 1, {section}", POLARIS)
    tags = Tags(order=3, magnets=4, orientations=8)
    ids = dispatch.capacity(tags)
    to.add("polaris, K = 3, M = 4, P = 8", ids, 20_480, "ids", "Eq. 1", POLARIS)
    largest = Tags(order=3, magnets=8, orientations=16)
    largest_bits = math.log2(dispatch.capacity(largest))
    how = "section 1: nine magnets on 3 x 3 cells, of which Eq. 1 allows eight"
    to.add("polaris, tag of 3 x 3 cm", largest_bits, 36, "bits", how, POLARIS, digits=None)
    for degrees, count in ((20, 90), (10, 180), (1, 1800)):
        grid = TemplateGrid(orientations=360 // degrees)
        templates = len(template_set(Tags(), 0.01, grid).angle_rad)
        how = "Eq. 2 without counting 0 and 360 degrees as two; 8.3.5"
        to.add(f"polaris, templates at {degrees} degrees", templates, count, "", how, POLARIS)
    magnet, clearance_m = Tags().magnet, Tags().clearance_m
    width_m = field_width(magnet, clearance_m, SEPARATION_FIELD_FRACTION)
    how = "0.8 of the distance without overlap, 5.2.3; the paper states 4 cm"
    spacing_mm = 1e3 * COMPACT_SPACING_FRACTION * width_m
    to.add("polaris, smallest spacing by the rule", spacing_mm, 40, "mm", how, POLARIS)
    rounded_mm = 1e3 * compact_spacing(magnet, clearance_m)
    to.add("polaris, spacing of the default tag", rounded_mm, 40, "mm", "8.3.1", POLARIS)


# ---- landmarks


def _add_landmarks(to: _Calculations) -> None:
    patterns = len(np.unique(PATTERN_OF))
    to.add("landmarks, patterns of four bars", patterns, 6, "", "Fig. 1", LANDMARKS)
    how = "patterns with their orientations; the paper reads patterns only"
    to.add("landmarks, codes", CODE_COUNT, 6, "", how, LANDMARKS, digits=None)
    analysis = analyse_landmark(Geometry())
    how = "Fig. 3 and 4, for the default bars; the paper's are unknown, and many have these radii"
    to.add("landmarks, r1", 1e3 * analysis.r1_m, 45, "mm", how, LANDMARKS, digits=0.7)
    to.add("landmarks, r2", 1e3 * analysis.r2_m, 54, "mm", how, LANDMARKS, digits=0.7)
    for pattern, valleys in zip(analysis.patterns, (4, 6, 6, 6, 8, 8), strict=True):
        how = f"Fig. 6, {pattern.letters}"
        count = len(pattern.valleys_rad)
        to.add(
            f"landmarks, valleys of pattern {pattern.number}", count, valleys, "", how, LANDMARKS
        )
    bias_mm = 1e3 * max(float(np.hypot(*pattern.bias_m)) for pattern in analysis.patterns)
    how = "3.3, facing valleys meet in the centre; largest distance of all patterns"
    to.add("landmarks, centre by valleys", bias_mm, 0, "mm", how, LANDMARKS, digits=None)
    skew = math.degrees(max(pattern.skew_rad for pattern in analysis.patterns))
    how = "Fig. 4, largest deviation of a valley from multiples of 45 degrees"
    to.add("landmarks, valleys off 45 degrees", skew, 0, "deg", how, LANDMARKS, digits=None)
    floor = design_map(DesignOptions(24, 24))
    duplicates = prove_map(floor).duplicate_count
    how = "4.2, readings of L windows that occur twice on a map of 24 x 24"
    to.add("landmarks, ambiguous L windows", duplicates, 0, "", how, LANDMARKS)
    worst = count_localization_steps(floor).worst
    how = "4.2, landmarks until the position is known, any start on this map"
    to.add("landmarks, needed for the position", float(worst or math.nan), 3, "", how, LANDMARKS)


# ---- Lighthouse


def _add_lighthouse(to: _Calculations) -> None:
    to.add("lighthouse, polynomials", len(lfsr.TAPS), 32, "", "II.B", LIGHTHOUSE)
    state_counts = [
        len(np.unique(lfsr.state_at(np.arange(lfsr.SEQUENCE_LENGTH), polynomial)))
        for polynomial in range(POLYNOMIAL_COUNT)
    ]
    how = "shift register of 17 bits: states that the shortest of 32 sequences passes through"
    to.add("lighthouse, LFSR period", min(state_counts), 2**17 - 1, "", how, LIGHTHOUSE)
    fraction = _confused_windows(24)
    how = f"II.B, windows of 24 bits within one bit of another polynomial, of {WINDOW_SAMPLES}"
    to.add(
        "lighthouse, ambiguous windows of 24 bits", 100 * fraction, 0, "%", how, LIGHTHOUSE,
        digits=None,
    )  # fmt: skip
    count_udeg = 1e6 * 360 / float(period_counts(1))
    how = "IV.A, one count of channel 1, of which the stated fluctuation would be a tenth"
    to.add(
        "lighthouse, angle of one count", count_udeg, 300, "microdegrees", how, LIGHTHOUSE,
        digits=None,
    )  # fmt: skip
    pulse_s = sum(LIGHTHOUSE_STAGES_S)
    how = "IV.E, sum of three stages of Table III; about 1 ms"
    to.add("lighthouse, time of a pulse", 1e3 * pulse_s, 1, "ms", how, LIGHTHOUSE, digits=0.1)
    sweeps_hz = float(np.sum(2 * TICK_HZ / period_ticks([1, 2])))
    how = "II.B, sweeps of two stations times the time of a pulse"
    load = 100 * pulse_s * sweeps_hz
    to.add("lighthouse, load of two stations", load, 19, "%", how, LIGHTHOUSE, digits=1.0)


def _confused_windows(length: int) -> float:
    """Return the fraction of windows that differ by at most one bit from another polynomial."""
    rng = np.random.default_rng(24)
    polynomial = rng.integers(0, POLYNOMIAL_COUNT, WINDOW_SAMPLES)
    index = rng.integers(0, int(period_counts(1)), WINDOW_SAMPLES)
    window = lfsr.bits_at(index, polynomial, length)
    others = np.arange(POLYNOMIAL_COUNT)[:, None]
    occurs = np.zeros((POLYNOMIAL_COUNT, WINDOW_SAMPLES), bool)
    for flip in (np.uint64(0), *(np.uint64(1 << bit) for bit in range(length))):
        variant = window ^ flip
        state = (variant >> np.uint64(length - lfsr.REGISTER_BITS)).astype(np.int64)
        found = lfsr.indices(state, others)
        occurs |= (state > 0) & (lfsr.bits_at(found, others, length) == variant)
    occurs[polynomial, np.arange(WINDOW_SAMPLES)] = False
    return float(occurs.any(axis=0).mean())
