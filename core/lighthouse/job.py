"""One session of sweeps under way: the scene that it is located in, and how it is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import (
    GENERIC_CALIBRATION,
    MODEL_SIGMA_RAD,
    Calibration,
    ideal_angles,
)
from locatk.core.lighthouse.epochs import Epochs, rotor_angles
from locatk.core.lighthouse.light_planes import rays as rays_of
from locatk.core.lighthouse.localization.floor_map import fit_floor_homography
from locatk.core.lighthouse.noise import INLIER_GATE_RAD
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene import frame as frames
from locatk.core.lighthouse.scene.assembly import Assembly, estimate_stations
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState, adjust_bundle
from locatk.core.lighthouse.scene.keyframes import average_standstills
from locatk.core.lighthouse.scene.resection import resect_on_plane
from locatk.core.trajectory import Trajectory

if TYPE_CHECKING:
    from locatk.core.lighthouse.solver import SolveOptions

Array = NDArray[np.float64]

LARGEST_MISFIT_M = 0.02
"""Rms distance of markers from where the stations see them that calls for a word: ten times
what hand measurement and a guessed calibration leave."""


@dataclass
class Job:
    """One session under way; also counts what is left out and notes what is assumed.

    ``verified`` are angles (n, s, 2) of places to verify a scene with that was solved here, and
    ``held_out`` tells whether they took no part in that. In a scene that was given every moment
    will do.
    """

    epochs: Epochs
    scene: Scene
    options: SolveOptions
    odometry: Sequence[Trajectory]
    notes: list[str] = field(default_factory=list)
    facts: dict[str, object] = field(default_factory=dict)
    verified: Array | None = None
    held_out: bool = True

    def __post_init__(self) -> None:
        self.rejected = dict(self.epochs.rejected)
        self.angles = rotor_angles(self.epochs)

    def reject(self, reason: str, number: int | np.signedinteger) -> None:
        if number:
            self.rejected[reason] = self.rejected.get(reason, 0) + int(number)

    def keep_stations(self, columns: Sequence[int], reason: str) -> None:
        """Leave the sweeps of all other stations out."""
        gone = [i for i in range(len(self.epochs.channels)) if i not in columns]
        self.reject(reason, np.count_nonzero(np.isfinite(self.epochs.counts[:, gone])))
        self.epochs = replace(
            self.epochs,
            channels=self.epochs.channels[list(columns)],
            counts=self.epochs.counts[:, list(columns)],
        )
        self.angles = self.angles[:, list(columns)]

    def correct(self, rows: NDArray[np.int64], counts: Array) -> None:
        """Take other counts (n, s, 2) for some moments."""
        corrected = self.epochs.counts.copy()
        corrected[rows] = counts
        self.epochs = replace(self.epochs, counts=corrected)
        self.angles = rotor_angles(self.epochs)

    @property
    def kind(self) -> str:
        """Kind of scene, ``two-auto`` where the data must tell whether it is planar."""
        if self.options.scene != "auto":
            return self.options.scene
        if len(self.epochs.channels) == 1:
            return "one-planar"
        return {True: "two-planar", False: "two-3d", None: "two-auto"}[self.scene.planar]

    def calibration(self, channel: int) -> Calibration:
        """What is known of a station's calibration, else the mean of other units."""
        return self.scene.calibrations.get(channel, GENERIC_CALIBRATION)

    # ---- scenes

    def known_scene(self) -> Scene:
        """The given scene, with the recording reduced to its stations."""
        columns = [
            i for i, channel in enumerate(self.epochs.channels) if self.scene.station(int(channel))
        ]
        if not columns:
            raise DegenerateError(
                "the scene has none of the recording's stations",
                hint="its channels are "
                + ", ".join(str(s.channel) for s in self.scene.stations)
                + "; the recording has "
                + ", ".join(str(c) for c in self.epochs.channels),
            )
        if len(columns) < len(self.epochs.channels):
            self.keep_stations(columns, "station_not_in_scene")
        self.notes.extend(self.scene.notes)
        return self.scene

    def solve_scene(self) -> Scene:
        """Stations from the recording, in metres where anything gives the scale."""
        if self.kind == "one-planar":
            return self._solve_one()
        if len(self.epochs.channels) < 2:
            raise DegenerateError(
                f"a {self.kind} scene needs two stations and the recording has one",
                hint="use --scene one-planar with markers",
            )
        planar = {"two-planar": True, "two-3d": False}.get(self.kind)
        places, _ = average_standstills(self.angles, self.epochs.device)
        assembly = estimate_stations(
            places,
            tuple(self.calibration(int(c)) for c in self.epochs.channels),
            sigma=MODEL_SIGMA_RAD,
            planar=planar,
            misfit=self._marker_misfit if self.scene.markers else None,
            seed=self.options.seed,
        )
        self._leave_out(assembly)
        rows = assembly.held_out if len(assembly.held_out) else assembly.chosen
        self.verified = places[rows][:, list(assembly.stations)]
        self.held_out = len(assembly.held_out) > 0
        self.facts.update(assembly.facts)
        self.facts["planar"] = assembly.planar
        if planar is None:
            self.notes.append(
                "the data lie on one plane" if assembly.planar else "the data fill space"
            )
        share = assembly.facts["plane_share"]
        if assembly.planar and isinstance(share, float) and share < 0.95:
            self.notes.append(
                f"{1.0 - share:.0%} of the places contradict the plane as they were reported "
                "(carried robots, swapped sweeps, reflections)"
            )
        readings = [c for c in _candidates(assembly.facts) if c["fits"]]
        if len(readings) > 1 and "reading_decided_by" not in assembly.facts:
            self.notes.append(
                "two arrangements of the stations explain the angles equally well; chosen is "
                "the one with less roll"
            )
        return self._framed(
            assembly.adjustment.rig, assembly.planar, assembly.adjustment.station_covariance
        )

    def _leave_out(self, assembly: Assembly) -> None:
        """Leave stations out that could not be solved, and say which and why."""
        if not assembly.left_out:
            return
        for reason in dict.fromkeys(assembly.left_out.values()):
            channels = [
                str(self.epochs.channels[k])
                for k, other in sorted(assembly.left_out.items())
                if other == reason
            ]
            self.notes.append(f"station on channel {', '.join(channels)} {reason}: left out")
        self.keep_stations(assembly.stations, "station_not_solved")

    def _marker_misfit(self, rig: BundleState, columns: tuple[int, int]) -> float:
        """Rms distance in metres of the markers from where two stations on a plane see them;
        infinite where too few are seen to tell."""
        known, seen = frames.sighted_markers(self.scene.markers, self.epochs, self.angles)
        return frames.marker_misfit(rig, True, known, seen[:, columns])

    def _solve_one(self) -> Scene:
        """One station on a plane, by resection on its markers."""
        known, seen = frames.sighted_markers(self.scene.markers, self.epochs, self.angles)
        column = 0
        if len(self.epochs.channels) > 1:
            sights = np.count_nonzero(np.isfinite(seen).all(axis=2), axis=0)
            column = int(np.argmax(sights))
            self.keep_stations([column], "other_station")
            seen = seen[:, [column]]
        full = np.isfinite(seen).all(axis=(1, 2))
        known, seen = known[full], seen[full]
        if len(known) < 4:
            raise DegenerateError(
                f"one station needs four sighted markers on the floor and has {len(known)}",
                hint="add [[markers]] with sightings to a scene.toml and give it by --artifact, "
                "or record with two stations",
            )
        floor_z = float(np.mean(known[:, 2]))
        flat = known - np.array([0.0, 0.0, floor_z])
        calibration = self.calibration(int(self.epochs.channels[0]))
        rays = rays_of(ideal_angles(seen[:, 0], calibration), calibration.tilts)
        position, rotation = resect_on_plane(flat[:, :2], rays)
        done = adjust_bundle(
            seen,
            BundleState(position[None], rotation[None], (calibration,), flat),
            sigma=MODEL_SIGMA_RAD,
            planar=True,
            fixed_points=True,
            calibrate=False,
        )
        self.facts["planar"] = True
        self.facts["marker_residual_rad"] = float(np.sqrt(np.nanmean(done.residuals**2)))
        rig = done.rig
        raised = rig.positions + np.array([0.0, 0.0, floor_z])
        rig = BundleState(raised, rig.rotations, rig.calibrations, rig.points)
        solved = self._scene_of(rig, True, floor_z, "markers", done.station_covariance)
        station = replace(solved.stations[0], floor_map=fit_floor_homography(flat[:, :2], rays))
        return replace(solved, stations=(station,))

    def _framed(self, rig: BundleState, planar: bool, covariance: Array) -> Scene:
        """Bring a rig into the frame and scale that markers, distances or odometry give."""
        known, seen = frames.sighted_markers(self.scene.markers, self.epochs, self.angles)
        to = frames.place_on_markers(rig, planar, known, seen)
        if to is not None:
            misfit = frames.marker_misfit(rig, planar, known, seen)
            self.facts["marker_misfit_m"] = misfit if np.isfinite(misfit) else None
            if LARGEST_MISFIT_M < misfit < np.inf:
                self.notes.append(
                    f"the markers are {1e3 * misfit:.0f} mm (rms) from where the stations see "
                    "them: a marker is measured wrong, or the scene is"
                )
            rig = frames.transform_state(rig, to)
            covariance = frames.transform_covariance(covariance, to.scale, to.rotation)
            floor_z = float(np.mean(known[:, 2])) if planar else 0.0
            if planar and np.mean(rig.positions[:, 2]) < floor_z:
                self.notes.append(
                    "the stations hang below the floor: x and y of the markers turn clockwise "
                    "seen from above, so that their z points down"
                )
            return self._scene_of(rig, planar, floor_z, "markers", covariance)
        if self.scene.markers:
            self.notes.append(
                "fewer than three markers were sighted by enough stations: they fix no frame"
            )
        scale, source = self._scale(rig, planar)
        to = frames.at_first_station(rig, planar, scale)
        frame = self.scene.frame if planar else f"station-{self.epochs.channels[0]}"
        scene = self._scene_of(
            frames.transform_state(rig, to),
            planar,
            0.0,
            source,
            frames.transform_covariance(covariance, scale, to.rotation),
        )
        return replace(scene, frame=frame)

    def _scale(self, rig: BundleState, planar: bool) -> tuple[float, str]:
        if self.scene.distances:
            scale = frames.scale_of_distances(
                lambda seen: frames.sight(rig, planar, seen).position,
                self.scene.distances,
                self.epochs,
                self.angles,
            )
            return scale, "distance"
        if self.odometry:
            fixes = frames.sight(rig, planar, self.angles)
            good = fixes.worst < INLIER_GATE_RAD
            position = np.where(good[:, None], fixes.position, np.nan)
            found = frames.scale_of_odometry(
                position,
                self.epochs.time_ns,
                self.epochs.device,
                self.epochs.devices,
                self.odometry,
            )
            if found is not None:
                return found, "odometry"
            self.notes.append("odometry does not tell the scale: too little motion")
        self.notes.append(
            "unit scale: nothing measures it, so the distance of the first two stations is 1; "
            "give markers, a distance or odometry"
        )
        return 1.0 / float(np.linalg.norm(rig.positions[1] - rig.positions[0])), "unit"

    def _scene_of(
        self, rig: BundleState, planar: bool, floor_z: float, scale: str, covariance: Array
    ) -> Scene:
        """The artifact: a station each, with the assumptions it stands on."""
        guessed = [
            str(channel)
            for channel, c in zip(self.epochs.channels, rig.calibrations, strict=True)
            if c.source in ("generic", "estimated")
        ]
        if guessed:
            self.notes.append(
                f"no factory calibration is known of channel {', '.join(guessed)}: the mean of "
                "other units is used (generic), refined where the data tell"
            )
        stations = tuple(
            Station(
                int(channel),
                rig.positions[i],
                rig.rotations[i],
                rig.calibrations[i],
                self.scene.ids.get(int(channel)),
                covariance=covariance[i, :6, :6],
            )
            for i, channel in enumerate(self.epochs.channels)
        )
        return Scene(
            stations,
            self.scene.markers,
            self.scene.distances,
            planar,
            floor_z,
            scale,
            self.scene.frame,
            tuple(self.notes),
        )


def _candidates(facts: dict[str, object]) -> list[dict[str, object]]:
    found = facts.get("candidates")
    return found if isinstance(found, list) else []
