"""Text and JSON of ``locatk camera design``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from locatk.cli import console, failures
from locatk.cli.materials_text import materials_text
from locatk.core.units import length_text

if TYPE_CHECKING:
    from locatk.core.dots.design.camera import CameraReport, SensorFit
    from locatk.core.dots.design.camera_measurement import CameraMeasurement


def print_design(
    report: CameraReport,
    measured: CameraMeasurement | None,
    reason: str,
    fits: Sequence[SensorFit],
    holder: Path | None,
    as_json: bool,
) -> None:
    """Print the report of a camera, and finish with its warnings.

    ``reason`` is why nothing was measured.
    """
    if holder is not None:
        console.result(f"Wrote {holder}\n")
    console.result(text(report, measured, fits))
    if measured is None:
        console.say(f"No frame was rendered: {reason}.")
    if as_json:
        console.emit_json(entry(report, measured, fits, holder))
    failures.finish_with_warnings(report.warnings)


def text(
    report: CameraReport, measured: CameraMeasurement | None, fits: Sequence[SensorFit]
) -> str:
    """Format report, measurement and table of sensors in 80 columns."""
    parts = [
        console.labelled(list(_head(report))),
        console.table(("planned", "", "limit", "by"), list(_limits(report))),
        console.table(("pose of a frame", "predicted", "rendered"), _poses(report, measured)),
        console.table(
            ("sensor", "fits", "lens mm", "distance", "sigma um", "why not"), list(_sensors(fits))
        ),
        materials_text(report.materials),
    ]
    return "\n\n".join(parts)


def entry(
    report: CameraReport,
    measured: CameraMeasurement | None,
    fits: Sequence[SensorFit],
    holder: Path | None,
) -> dict[str, Any]:
    """Return the object for ``--json``, in SI units as each key says."""
    from locatk.formats.exporters.bill_of_materials import bill_rows, total_entry

    figures = asdict(report)
    setup = figures.pop("setup")
    for key in ("materials", "warnings"):
        del figures[key]
    figures["depth_of_field_m"] = report.depth_of_field_m
    return {
        "version": 1,
        "holder": holder,
        "setup": setup,
        "figures": figures,
        "rendered": None
        if measured is None
        else {
            "frames": measured.frames,
            "read": measured.read,
            "read_rate": measured.read_rate,
            "position_rms_m": measured.position_rms_m,
            "heading_rms_rad": measured.heading_rms_rad,
            "stated_sigma_m": measured.stated_sigma_m,
        },
        "sensors": [
            {
                "name": fit.sensor.name,
                "fits": fit.fits,
                "focal_m": fit.report.setup.lens.focal_m,
                "distance_m": fit.report.setup.distance_m,
                "position_sigma_m": fit.report.position_sigma_m,
                "read_rate": fit.report.read_rate,
                "reasons": fit.reasons,
            }
            for fit in fits
        ],
        "materials": bill_rows(report.materials),
        "materials_total": total_entry(report.materials),
        "warnings": report.warnings,
    }


def _head(report: CameraReport) -> Iterator[tuple[str, str]]:
    from locatk.core.dots.design.camera_optics import illuminance_text

    setup = report.setup
    width, height = setup.size_px
    yield (
        "Sensor",
        f"{setup.sensor.name}: {width} x {height} px of {setup.pixel_m * 1e6:g} um, "
        f"{setup.sensor.shutter} shutter, {setup.sensor.max_fps:g} frames/s",
    )
    yield (
        "Lens",
        f"{length_text(setup.lens.focal_m)}, f/{setup.lens.f_number:g}, "
        f"{length_text(setup.distance_m)} above the paper, "
        f"{length_text(report.image_distance_m)} from the sensor",
    )
    yield (
        "Field",
        f"{_mm(report.field_m[0])} x {length_text(report.field_m[1])} "
        f"({report.dots_in_view[0]} x {report.dots_in_view[1]} dots), "
        f"{report.metres_per_px * 1e6:.3g} um per px",
    )
    yield (
        "Exposure",
        f"{setup.exposure_s * 1e6:.0f} us, needs {illuminance_text(report.needed_illuminance_lx)} "
        f"(without gain {illuminance_text(report.full_illuminance_lx)}), "
        f"noise {report.noise_levels:.3g} grey values",
    )
    yield (
        "Task",
        f"{setup.speed_mps:g} m/s, {math.degrees(setup.yaw_rate_rps):g} deg/s, "
        f"{setup.wanted_rate_hz:g} poses/s",
    )


def _limits(report: CameraReport) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, value, limit and origin of the limit of each figure."""
    from locatk.core.dots.design.camera import GOOD_WINDOW_DOTS, MIN_WINDOW_DOTS
    from locatk.core.dots.design.camera_optics import frame_rate
    from locatk.core.dots.design.read_rate import MAX_MOTION_PITCHES, MIN_PX_PER_PITCH

    setup = report.setup
    pitch_px = report.pixels_per_pitch
    yield (
        "dots in any direction",
        f"{report.window_dots} x {report.window_dots}",
        f"min {MIN_WINDOW_DOTS} x {MIN_WINDOW_DOTS}",
        f"better {GOOD_WINDOW_DOTS} x {GOOD_WINDOW_DOTS}",
    )
    yield (
        "px per pitch",
        f"{pitch_px:.1f}",
        f"min {MIN_PX_PER_PITCH:g}",
        f"{report.searched_px_per_pitch:.1f} where searched",
    )
    yield (
        "distance",
        f"{length_text(setup.distance_m, 4)}",
        f"{_mm(report.near_m)} to {_far(report.far_m)}",
        f"blur circle {report.circle_of_confusion_m * 1e6:.0f} um",
    )
    yield (
        "blur, focus and lens",
        f"{report.blur_px:.2g} px",
        "",
        f"diffraction disc {report.airy_px:.2g} px",
    )
    yield (
        "motion and rotation",
        f"{report.motion_px:.2g}, {report.rotation_px:.2g} px",
        f"max {MAX_MOTION_PITCHES * pitch_px:.1f} px",
        f"{report.one_pixel_speed_mps:.3g} m/s, {report.one_pixel_yaw_rate_rps * 30 / math.pi:.3g} "
        "rpm give 1 px",
    )
    longest = (
        "any" if math.isinf(report.max_exposure_s) else f"{report.max_exposure_s * 1e6:.0f} us"
    )
    yield "exposure", f"{setup.exposure_s * 1e6:.0f} us", f"max {longest}", "at these speeds"
    yield (
        "speed",
        f"{setup.speed_mps:g} m/s",
        f"max {report.max_speed_mps:.2g} m/s",
        "with this exposure",
    )
    yield (
        "turn rate",
        f"{math.degrees(setup.yaw_rate_rps):.0f} deg/s",
        f"max {math.degrees(report.max_yaw_rate_rps):.3g} deg/s",
        "at the corner",
    )
    yield "distortion of a corner", f"{report.distortion_px:.1f} px", "", "calibrate camera"
    yield (
        "frames per second",
        f"{report.needed_fps:.3g}",
        f"max {frame_rate(setup):.3g}",
        f"{_mm(report.pose_spacing_m)} mm apart at most",
    )
    yield "latency", f"{report.latency_s * 1e3:.1f} ms", "", "read-out and decoding on a PC"


def _poses(report: CameraReport, measured: CameraMeasurement | None) -> list[tuple[str, str, str]]:
    """Return rows of predicted and rendered figures of a pose."""
    rendered = ("", "", "")
    if measured is not None:
        rendered = (
            f"{100 * measured.read_rate:.0f} % of {measured.frames}",
            _um(measured.position_rms_m),
            _degrees(measured.heading_rms_rad),
        )
    return [
        ("frames that are read", f"{100 * report.read_rate:.0f} %", rendered[0]),
        ("sigma of x and y", _um(report.position_sigma_m), rendered[1]),
        ("sigma of the heading", _degrees(report.heading_sigma_rad), rendered[2]),
        ("sigma of x, y, print not calibrated", _um(report.absolute_position_sigma_m), ""),
    ]


def _sensors(fits: Sequence[SensorFit]) -> Iterator[tuple[str, ...]]:
    for fit in fits:
        setup = fit.report.setup
        yield (
            fit.sensor.name,
            "yes" if fit.fits else "no",
            _mm(setup.lens.focal_m),
            length_text(setup.distance_m),
            f"{fit.report.position_sigma_m * 1e6:.2g}",
            fit.reasons[0].partition(":")[0] if fit.reasons else "",
        )


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m:.3g}"


def _far(value_m: float) -> str:
    return "any" if math.isinf(value_m) else length_text(value_m)


def _um(value_m: float) -> str:
    return f"{value_m * 1e6:.2g} um" if math.isfinite(value_m) else "-"


def _degrees(value_rad: float) -> str:
    return f"{math.degrees(value_rad):.2g} deg" if math.isfinite(value_rad) else "-"
