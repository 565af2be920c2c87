"""Settings of ``locatk simulate dots``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from locatk.core.dots.sheet import Manifest
from locatk.core.dots.simulation import session as simulation
from locatk.core.dots.simulation.paths import PATHS
from locatk.core.dots.simulation.session import SimulationOptions
from locatk.core.simulation import check_session_size
from locatk.formats.artifacts import sheets
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE,
    Boolean,
    FilePath,
    Integer,
    Number,
    Row,
    Text,
)
from locatk.formats.sessions.frames import Shot, write_shots
from locatk.formats.settings.config import SettingsConfig, SettingsError
from locatk.formats.settings.setting import Requirement, Setting

CODECS = ("anoto", "libdots", "microdots")

LENS_DISTORTION_PERCENT = 4.5
"""Distortion of the paper's lens (:data:`locatk.core.dots.simulation.session.LENS_DISTORTION`)."""

SHEET_FILE, SHEET_ID, CODEC = "sheet.file", "sheet.id", "sheet.codec"
PRINTER_SCALE, IS_SCALE_KNOWN = "print.scale", "print.scale_known"
FRAMES, DURATION = "path.frames", "path.duration_s"
CAMERA_FILE, IS_CALIBRATED = "camera.file", "camera.calibrated"
DISTORTION = "camera.distortion_percent"
PITCH, ROLL = "camera.pitch_deg", "camera.roll_deg"

CONFIG = SettingsConfig(
    "dots",
    (
        Setting(
            SHEET_FILE,
            FilePath(),
            "Manifest of the sheet to drive on",
            flag="--sheet",
            default=None,
            default_text="an A4 sheet",
            example="sheet.toml",
            metavar="MANIFEST",
        ),
        Setting(
            SHEET_ID,
            Text(),
            "Sheet of the manifest",
            flag="--id",
            default=None,
            default_text="the first",
            example="floor",
            metavar="ID",
        ),
        Setting(
            CODEC,
            Text(CODECS),
            "Codec of the A4 sheet; a manifest states its own",
            former_flag="--codec",
            default=CODECS[0],
        ),
        Setting(FRAMES, Integer(1), "Number of frames", "frames", "--frames"),
        Setting(
            DURATION,
            POSITIVE,
            "Duration, instead of the number of frames",
            flag="--duration",
            default=None,
            default_text="that of the frames",
            example=10.0,
        ),
        Setting("path.rate_hz", POSITIVE, "Rate of the frames", "rate_hz", "--rate"),
        Setting(
            "path.kind",
            Text(PATHS),
            "Drive along a curve, jump to a random pose in each frame, or stand still",
            "path",
            "--path",
        ),
        Setting(
            "path.speed_mps",
            NOT_NEGATIVE,
            "Speed along the curve; with the paper's exposure of 0.13 ms, 0.35 m/s blur by 1 px",
            "speed_mps",
            "--speed",
        ),
        Setting(
            "path.motion_px",
            Number(0.0, 100.0),
            "Motion blur, independent of the speed",
            "motion_px",
            "--motion",
            default_text="that of the speed",
            example=2.0,
        ),
        Setting(
            "print.dot_pitches",
            POSITIVE,
            "Diameter of a printed dot: 1/6 as sent to the printer, more with dot gain",
            "dot",
            former_flag="--dot",
        ),
        Setting(
            "print.missing_fraction",
            FRACTION,
            "Fraction of the dots that are missing",
            "missing",
            "--missing",
        ),
        Setting(
            "print.dust_fraction",
            FRACTION,
            "Number of dark specks, as a fraction of the number of dots",
            "dust",
            former_flag="--dust",
        ),
        Setting(
            "print.jitter_um",
            NOT_NEGATIVE,
            "Standard deviation of the position of a dot",
            "jitter_m",
            former_flag="--jitter",
        ),
        Setting(
            PRINTER_SCALE,
            Row(ANY_NUMBER, 2),
            "True over nominal length on the paper, x and y",
            "printer_scale",
            "--printer-scale",
            default_text="that of the manifest",
            example=(1.002, 0.999),
            metavar="X,Y",
        ),
        Setting(
            IS_SCALE_KNOWN,
            Boolean(),
            "The manifest of the session states that scale, as if measured",
            flag="--scale-known/--scale-unknown",
            default=False,
        ),
        Setting(
            CAMERA_FILE,
            FilePath(),
            "Another camera (camera.toml) than the paper's",
            flag="--camera",
            default=None,
            default_text="the paper's camera",
            example="camera.toml",
        ),
        Setting(
            IS_CALIBRATED,
            Boolean(),
            "The session contains the camera's parameters",
            former_flag="--calibrated --uncalibrated",
            default=True,
        ),
        Setting(
            DISTORTION,
            Number(-20.0, 20.0),
            "Displacement of the corners by the lens, inwards",
            former_flag="--distortion",
            default=LENS_DISTORTION_PERCENT,
        ),
        Setting(
            PITCH,
            ANY_NUMBER,
            "Rotation of the mounted camera about the right of the image",
            "pitch_rad",
            former_flag="--askew",
        ),
        Setting(
            ROLL,
            ANY_NUMBER,
            "Rotation of the mounted camera about the image's downward axis",
            "roll_rad",
            former_flag="--askew",
        ),
        Setting(
            "camera.tilt_deg",
            Number(0.0, 45.0),
            "Largest tilt of a frame, in a random direction",
            "tilt_rad",
            former_flag="--tilt",
        ),
        Setting(
            "camera.blur_px",
            NOT_NEGATIVE,
            "Standard deviation of the defocus",
            "blur_px",
            former_flag="--blur",
        ),
        Setting(
            "camera.noise_grey",
            NOT_NEGATIVE,
            "Standard deviation of a pixel, of 255",
            "noise",
            "--noise",
        ),
        Setting(
            "light.contrast_fraction",
            FRACTION,
            "Contrast; 1 is black on white",
            "contrast",
            former_flag="--contrast",
        ),
        Setting(
            "light.vignette_fraction",
            FRACTION,
            "Loss of light in the corners",
            "vignette",
            former_flag="--vignette",
        ),
        Setting(
            "light.gradient_fraction",
            FRACTION,
            "Loss of light on one side",
            "gradient",
            former_flag="--gradient",
        ),
        Setting("random.seed", Integer(0), "Seed of all random numbers", "seed", "--seed"),
    ),
    SimulationOptions(),
    conflicts=(((FRAMES,), (DURATION,)),),
    requirements=(Requirement(IS_SCALE_KNOWN, PRINTER_SCALE),),
)
"""Settings of the command."""


def write_simulation(
    output: str | os.PathLike[str],
    settings: Mapping[str, Any],
    *,
    overwrite: bool = False,
    progress: Callable[[range], AbstractContextManager[Iterable[int]]] = nullcontext,
) -> dict[str, Any]:
    """Simulate frames of a camera over a sheet, and write them one by one into a session.

    ``progress`` wraps the numbers of the frames. Returns the summary for ``--json``.

    Raises
    ------
    LocatkError
        A file is missing or invalid, or the settings cannot be simulated.
    """
    manifest = _read_sheet(settings)
    options = simulation_options(settings, manifest)
    if settings.get(IS_SCALE_KNOWN, False):
        manifest = replace(manifest, scale=settings[PRINTER_SCALE])
    simulated = simulation.simulate(manifest, options)
    frames = simulated.frames
    is_calibrated = settings.get(IS_CALIBRATED, True)

    def shots(numbers: Iterable[int]) -> Iterable[Shot]:
        for k in numbers:
            yield Shot(int(frames.time_ns[k]), frames.names[k], frames.images[k])

    with progress(range(len(frames))) as numbers:
        counts = write_shots(
            output,
            {frames.device: shots(numbers)},
            manifest=simulated.manifest,
            camera=simulated.camera if is_calibrated else None,
            truth=(simulated.truth,),
            facts={f"simulated_{name}": str(value) for name, value in asdict(options).items()},
            overwrite=overwrite,
        )
    return {
        "frames": counts[frames.device],
        "device": frames.device,
        "frame": simulated.truth.frame,
        "codec": manifest.codec,
        "calibrated": is_calibrated,
        "truth_poses": len(simulated.truth),
    }


def _read_sheet(settings: Mapping[str, Any]) -> Manifest:
    """Return the manifest to simulate, as it is stated in its file."""
    file = settings.get(SHEET_FILE)
    if file is None:
        return simulation.sheet(settings.get(CODEC, CODECS[0]))
    return sheets.read_manifest(file)


def simulation_options(settings: Mapping[str, Any], manifest: Manifest) -> SimulationOptions:
    """Return the options of a simulation over a sheet of ``manifest``.

    Raises
    ------
    SettingsError
        The manifest has no such sheet.
    MissingDataError, ArtifactError
        The camera is missing or invalid.
    InputError
        A value is out of its range.
    """
    values = CONFIG.in_si(settings)
    for key in (SHEET_FILE, CODEC, IS_SCALE_KNOWN, IS_CALIBRATED):
        values.pop(key, None)
    distortion = values.pop(DISTORTION, LENS_DISTORTION_PERCENT) / 100
    file = values.pop(CAMERA_FILE, None)
    duration_s = values.pop(DURATION, None)
    if duration_s is not None:
        rate_hz = values.get("rate_hz", SimulationOptions.rate_hz)
        check_session_size(duration_s * rate_hz, duration_s)
        values["frames"] = max(1, round(duration_s * rate_hz))
    return SimulationOptions(
        camera=sheets.read_camera(Path(file)) if file else simulation.camera(distortion),
        sheet=_sheet_number(manifest, values.pop(SHEET_ID, None)),
        **values,
    )


def _sheet_number(manifest: Manifest, sheet_id: str | None) -> int:
    """Return the number of the sheet with this id."""
    ids = [sheet.id for sheet in manifest.sheets]
    if sheet_id is None:
        return 0
    if sheet_id not in ids:
        raise SettingsError(f"There is no sheet {sheet_id!r}; the manifest has {', '.join(ids)}")
    return ids.index(sheet_id)
