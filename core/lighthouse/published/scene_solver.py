"""A session solved by the paper's method: poses without uncertainty."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, umeyama
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.epochs import Epochs
from locatk.core.lighthouse.light_planes import angles_to_counts, paper_image_points
from locatk.core.lighthouse.localization.photodiodes import detections
from locatk.core.lighthouse.published import scene as paper
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene import frame as frames
from locatk.core.lighthouse.scene.keyframes import require_distinct_positions
from locatk.core.solution import Solution, SolverWarning, from_json
from locatk.core.trajectory import Trajectory

if TYPE_CHECKING:
    from locatk.core.lighthouse.job import Job

Array = NDArray[np.float64]


def image_of(epochs: Epochs, angles: Array) -> Array:
    """Image points (m, s, 2) of the paper for rotor angles (m, s, 2)."""
    image = np.empty_like(angles)
    for i, channel in enumerate(epochs.channels):
        counts = angles_to_counts(angles[:, i], int(channel))
        image[:, i] = paper_image_points(counts, int(channel))
    return image


def solve_as_paper(job: Job) -> Solution:
    """Solve a session as the paper does (:mod:`locatk.core.lighthouse.published.scene`).

    One station: floor positions through markers. Two: the kind must be known (``--scene``;
    planar where the scene does not say), scale from markers or a distance, else unit.
    """
    kind = job.kind
    if kind == "two-auto":
        kind = "two-planar"
        job.notes.append("the paper must be told whether a scene is planar: taken as planar")
    columns = [0] if kind == "one-planar" else [0, 1]
    if len(job.epochs.channels) < len(columns):
        raise DegenerateError(
            f"a {kind} scene needs two stations and the recording has one",
            hint="use --scene one-planar with markers",
        )
    if len(job.epochs.channels) > len(columns):
        job.keep_stations(columns, "other_station")
    image = image_of(job.epochs, job.angles)
    seen = np.isfinite(image).all(axis=(1, 2))
    known, sighted = frames.sighted_markers(job.scene.markers, job.epochs, job.angles)
    full = np.isfinite(sighted).all(axis=(1, 2))
    known, sighted = known[full], image_of(job.epochs, sighted[full])

    if kind == "one-planar":
        solved = paper.one_planar(known[:, :2], sighted[:, 0])
        to, scale = Similarity.identity(), "markers"
    else:
        first, second = (np.insert(image[seen, k], 0, 1.0, axis=1) for k in (0, 1))
        require_distinct_positions(first, second, 4 if kind == "two-planar" else 8)
        solve = paper.two_planar if kind == "two-planar" else paper.two_3d
        solved = solve(image[seen])
        to, scale = _frame(job, solved, known, sighted)
    position = np.full((len(image), 3), np.nan)
    position[seen] = to.apply(solved.locate(image[seen]))
    good = np.isfinite(position).all(axis=1)
    job.reject("moment_with_too_few_sweeps", np.count_nonzero(~good))
    scene = Scene(
        tuple(
            Station(int(channel), to.apply(place), to.rotation @ rotation, IDEAL_CALIBRATION)
            for channel, (place, rotation) in zip(
                job.epochs.channels, solved.stations, strict=False
            )
        ),
        job.scene.markers,
        job.scene.distances,
        kind != "two-3d",
        0.0,
        scale,
        job.scene.frame,
        tuple(job.notes),
    )
    trajectories = tuple(
        Trajectory.from_positions(name, scene.frame, job.epochs.time_ns[mine], position[mine])
        for k, name in enumerate(job.epochs.devices)
        for mine in [np.flatnonzero(good & (job.epochs.device == k))]
    )
    return Solution(
        "lighthouse",
        "paper",
        trajectories,
        job.rejected,
        tuple(
            from_json(StationDetection, row)
            for row in detections(job.epochs, {s.channel: s for s in scene.stations})
        ),
        scene,
        tuple(SolverWarning("unspecified", text) for text in dict.fromkeys(job.notes)),
        from_json(LighthouseFacts, job.facts),
    )


def _frame(
    job: Job, solved: paper.PaperScene, known: Array, sighted: Array
) -> tuple[Similarity, str]:
    """Scale, and frame where markers give one."""
    if len(known) >= 3:
        return umeyama(solved.locate(sighted), known), "markers"
    unit = Similarity.identity()
    if job.scene.distances:
        scale = frames.scale_of_distances(
            lambda seen: solved.locate(image_of(job.epochs, seen)),
            job.scene.distances,
            job.epochs,
            job.angles,
        )
        return Similarity(scale, unit.rotation, unit.translation), "distance"
    job.notes.append("unit scale: the distance of the two stations is 1")
    return unit, "unit"
