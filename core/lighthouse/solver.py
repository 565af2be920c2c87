"""From sweeps to poses: the road that a session of Lighthouse sweeps takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.lighthouse import frame as frames
from locatk.core.lighthouse.angles import counts_to_angles
from locatk.core.lighthouse.angles import rays as rays_of
from locatk.core.lighthouse.assemble import assemble
from locatk.core.lighthouse.bundle import STATION_UNKNOWNS, Rig, adjust
from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.epochs import Epochs, group
from locatk.core.lighthouse.floor_map import fit_floor_map, locate_on_map
from locatk.core.lighthouse.generic import GENERIC, MODEL_SIGMA
from locatk.core.lighthouse.locate import Fixes, locate
from locatk.core.lighthouse.places import gather
from locatk.core.lighthouse.resection import resect_on_plane
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.sweeps import Sweeps
from locatk.core.robust import robust_sigma
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

SCENES = ("auto", "one-planar", "two-planar", "two-3d")
METHODS = ("bundle", "paper")

COUNT_SIGMA = 1.15e-4
"""Standard deviation of a rotor angle at a standstill, in radians: 2.2 LFSR steps, measured
on 4,759 moments of the published grid."""

GATE = 0.01
"""Angle by which a plane may miss the position it helped to find, in radians: what a robot
at half a metre a second moves between the sweeps of two stations, and a third of a
demodulation error."""

GATE_SIGMAS = 12.0
FINEST_GATE = 1.5e-3
"""The gate follows the noise of the recording at this many standard deviations, but stays
above what a generic calibration leaves unmodelled."""

REACH_M = 20.0
"""Base stations are not received farther away, in metres."""


@dataclass(frozen=True)
class SolveOptions:
    """What the user may choose.

    Attributes
    ----------
    method : str
        ``"bundle"`` or ``"paper"``.
    scene : str
        One of :data:`SCENES`; ``"auto"`` decides from stations and data.
    seed : int
        Of the random samples.
    """

    method: str = "bundle"
    scene: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, known in (
            ("method", self.method, METHODS),
            ("scene", self.scene, SCENES),
        ):
            if value not in known:
                raise InputError(
                    f"unknown {name} {value!r}", hint=f"choose one of {', '.join(known)}"
                )


def solve(
    sweeps: Sweeps,
    scene: Scene | None = None,
    options: SolveOptions | None = None,
    odometry: Sequence[Trajectory] = (),
) -> Solution:
    """Poses of all photodiodes in a recording.

    Parameters
    ----------
    sweeps : Sweeps
    scene : Scene, optional
        With stations: they are used as they are. Without: they are solved first; markers
        and distances then fix frame and scale.
    options : SolveOptions, optional
    odometry : sequence of Trajectory
        For the scale, where the scene has neither markers nor distances.

    Returns
    -------
    Solution
        Its ``artifact`` is the scene with stations, for later sessions.

    Raises
    ------
    DegenerateError
        The recording does not determine the scene; the message says what is missing.
    """
    scene = scene or Scene()
    options = options or SolveOptions()
    epochs = group(sweeps)
    if len(epochs) == 0 or len(epochs.channels) == 0:
        raise DegenerateError(
            "the recording has no usable sweep",
            hint="`locatk info` shows what it has; rejected: "
            + (", ".join(f"{n} {r}" for r, n in epochs.rejected.items()) or "nothing"),
        )
    job = Job(epochs, scene, options, odometry)
    if options.method == "paper":
        from locatk.core.lighthouse.paper_solver import solve_as_paper

        return solve_as_paper(job)
    solved = job.known_scene() if scene.stations else job.solve_scene()
    return _answer(job, solved)


@dataclass
class Job:
    """One session under way; also counts what is left out and notes what is assumed."""

    epochs: Epochs
    scene: Scene
    options: SolveOptions
    odometry: Sequence[Trajectory]
    notes: list[str] = field(default_factory=list)
    facts: dict[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.rejected = dict(self.epochs.rejected)
        self.angles = angles_of(self.epochs)

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
        return self.scene.calibrations.get(channel, GENERIC)

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
        places, _ = gather(self.angles, self.epochs.device)
        assembly = assemble(
            places,
            tuple(self.calibration(int(c)) for c in self.epochs.channels),
            sigma=MODEL_SIGMA,
            planar=planar,
            seed=self.options.seed,
        )
        if len(assembly.stations) < len(self.epochs.channels):
            left = [
                str(c) for i, c in enumerate(self.epochs.channels) if i not in assembly.stations
            ]
            self.notes.append(
                f"station on channel {', '.join(left)} shares too few places with the others "
                "and is left out"
            )
            self.keep_stations(assembly.stations, "station_not_solved")
        self.facts.update(assembly.facts)
        self.facts["planar"] = assembly.planar
        if planar is None:
            self.notes.append(
                "the data lie on one plane" if assembly.planar else "the data fill space"
            )
        readings = [c for c in _candidates(assembly.facts) if c["fits"]]
        if len(readings) > 1:
            self.notes.append(
                "two arrangements of the stations explain the angles equally well; chosen is "
                "the one with less roll"
            )
        return self._framed(
            assembly.adjustment.rig, assembly.planar, assembly.adjustment.station_covariance
        )

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
        done = adjust(
            seen,
            Rig(position[None], rotation[None], (calibration,), flat),
            sigma=MODEL_SIGMA,
            planar=True,
            fixed_points=True,
            calibrate=False,
        )
        self.facts["planar"] = True
        self.facts["marker_residual_rad"] = float(np.sqrt(np.nanmean(done.residuals**2)))
        rig = done.rig
        raised = rig.positions + np.array([0.0, 0.0, floor_z])
        rig = Rig(raised, rig.rotations, rig.calibrations, rig.points)
        solved = self._scene_of(rig, True, floor_z, "markers", done.station_covariance)
        station = replace(solved.stations[0], floor_map=fit_floor_map(flat[:, :2], rays))
        return replace(solved, stations=(station,))

    def _framed(self, rig: Rig, planar: bool, covariance: Array) -> Scene:
        """Bring a rig into the frame and scale that markers, distances or odometry give."""
        known, seen = frames.sighted_markers(self.scene.markers, self.epochs, self.angles)
        to = frames.place_on_markers(rig, planar, known, seen)
        if to is not None:
            rig = frames.moved(rig, to)
            covariance = _turned(covariance, to.scale, to.rotation)
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
            frames.moved(rig, to), planar, 0.0, source, _turned(covariance, scale, to.rotation)
        )
        return replace(scene, frame=frame)

    def _scale(self, rig: Rig, planar: bool) -> tuple[float, str]:
        if self.scene.distances:
            scale = frames.scale_of_distances(
                rig, planar, self.scene.distances, self.epochs, self.angles
            )
            return scale, "distance"
        if self.odometry:
            fixes = locate(
                self.angles,
                rig.positions,
                rig.rotations,
                rig.calibrations,
                floor_z=0.0 if planar else None,
            )
            good = fixes.worst < GATE
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
        self, rig: Rig, planar: bool, floor_z: float, scale: str, covariance: Array
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


def angles_of(epochs: Epochs) -> Array:
    """Rotor angles (m, s, 2) of epochs, in radians."""
    angles = np.empty_like(epochs.counts)
    for i, channel in enumerate(epochs.channels):
        angles[:, i] = counts_to_angles(epochs.counts[:, i], int(channel))
    return angles


def _candidates(facts: dict[str, object]) -> list[dict[str, object]]:
    found = facts.get("candidates")
    return found if isinstance(found, list) else []


def _turned(covariance: Array, scale: float, rotation: Array) -> Array:
    """Covariances (s, 10, 10) of stations after a similarity of their frame."""
    change = np.eye(STATION_UNKNOWNS)
    change[0:3, 0:3] = scale * rotation
    change[3:6, 3:6] = rotation
    return change @ covariance @ change.T


# ---- poses


def _answer(job: Job, scene: Scene) -> Solution:
    """Locate every moment in the scene, and say what was left out."""
    stations = [s for c in job.epochs.channels if (s := scene.station(int(c))) is not None]
    rig = (
        np.stack([s.position for s in stations]),
        np.stack([s.rotation for s in stations]),
        tuple(s.calibration for s in stations),
    )
    floor = scene.floor_z if scene.planar else None
    floor_map = stations[0].floor_map if len(stations) == 1 else None
    if floor_map is not None:
        fixes = locate_on_map(job.angles, rig[2][0], floor_map, scene.floor_z)
    else:
        fixes = locate(job.angles, *rig, floor_z=floor)
        fixes = _swap_back(job, fixes, rig, floor)
    gate = _gate(fixes)
    if floor_map is None:
        fixes = _without_worst_station(job, fixes, rig, floor, gate)

    unsolved = ~np.isfinite(fixes.position[:, 0])
    inconsistent = ~unsolved & (fixes.worst > gate)
    distance = np.min(
        np.linalg.norm(fixes.position[:, None] - rig[0], axis=2), axis=1, initial=np.inf
    )
    far = ~unsolved & ~inconsistent & (distance > REACH_M) & (scene.scale != "unit")
    job.reject("moment_with_too_few_sweeps", np.count_nonzero(unsolved))
    job.reject("moment_inconsistent", np.count_nonzero(inconsistent))
    job.reject("moment_out_of_reach", np.count_nonzero(far))
    good = ~(unsolved | inconsistent | far)
    jumps = _jumps(job.epochs, fixes, good)
    job.reject("moment_jumps", np.count_nonzero(jumps))
    good &= ~jumps

    sigma = _noise(fixes, good)
    job.facts["angle_sigma_rad"] = sigma
    covariance = fixes.covariance(sigma, floor is not None)
    trajectories = []
    for k, name in enumerate(job.epochs.devices):
        mine = np.flatnonzero(good & (job.epochs.device == k))
        trajectories.append(
            Trajectory.from_positions(
                name,
                scene.frame,
                job.epochs.time_ns[mine],
                fixes.position[mine],
                covariance[mine],
            )
        )
    return Solution(
        "lighthouse",
        job.options.method,
        tuple(trajectories),
        job.rejected,
        detections(job.epochs, {s.channel: s for s in stations}, fixes.residual, good),
        scene,
        tuple(dict.fromkeys(job.notes)),
        job.facts,
    )


def _gate(fixes: Fixes) -> float:
    """Angle by which a plane may miss its position, in radians: far out in what the
    recording itself shows, and never more than :data:`GATE`."""
    checked = fixes.residual[(fixes.freedom > 0) & (fixes.worst < GATE)]
    return float(np.clip(GATE_SIGMAS * robust_sigma(checked), FINEST_GATE, GATE))


def _jumps(epochs: Epochs, fixes: Fixes, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Moments that nothing checks and that leave the path of their device.

    Compared is each position with the median of the five around it, which a steady motion
    does not leave (Hampel's filter).
    """
    jumps = np.zeros(len(epochs), bool)
    if np.all(fixes.freedom[good] > 0):
        return jumps
    for device in range(len(epochs.devices)):
        mine = np.flatnonzero(good & (epochs.device == device))
        if len(mine) < 5:
            continue
        path = fixes.position[mine]
        first = np.clip(np.arange(len(mine)) - 2, 0, len(mine) - 5)
        window = first[:, None] + np.arange(5)
        away = np.linalg.norm(path - np.median(path[window], axis=1), axis=1)
        step = np.linalg.norm(np.diff(path, axis=0), axis=1)
        usual = max(float(np.percentile(away, 75)), float(np.percentile(step, 75)))
        # Over a pause in the recording a device may be anywhere.
        span = epochs.time_ns[mine[first + 4]] - epochs.time_ns[mine[first]]
        left = (away > 5 * usual) & (span < 2_000_000_000)
        jumps[mine] = left & (fixes.freedom[mine] <= 0)
    return jumps


def _swap_back(
    job: Job, fixes: Fixes, rig: tuple[Array, Array, tuple[Calibration, ...]], floor: float | None
) -> Fixes:
    """Give sweeps back to their stations where a report without polynomials mixed them up.

    Reports that sort all counts of two stations exchange a plane of theirs whenever the
    stations' counts cross. Such a moment contradicts itself as it is, and fits exactly
    with the exchange undone.
    """
    if job.epochs.labelled or len(job.epochs.channels) != 2:
        return fixes
    wrong = np.flatnonzero((fixes.worst > GATE) & (fixes.freedom > 0))
    restored = 0
    for planes in ((0,), (1,)):
        counts = job.epochs.counts[wrong].copy()
        counts[:, :, planes] = counts[:, ::-1, planes]
        trial = angles_of(replace(job.epochs, counts=counts))
        fresh = locate(trial, *rig, floor_z=floor)
        right = np.isfinite(fresh.position[:, 0]) & (fresh.worst < GATE / 2)
        rows = wrong[right]
        job.epochs.counts[rows], job.angles[rows] = counts[right], trial[right]
        _put(fixes, rows, fresh, right)
        restored += len(rows)
        wrong = wrong[~right]
    if restored:
        job.facts["moments_with_swapped_sweeps_restored"] = restored
        job.notes.append(
            f"{restored} moments had sweeps of the two stations swapped; they were given back"
        )
    return fixes


def _without_worst_station(
    job: Job,
    fixes: Fixes,
    rig: tuple[Array, Array, tuple[Calibration, ...]],
    floor: float | None,
    gate: float,
) -> Fixes:
    """Where one of three or more stations contradicts the others, go on without it."""
    if len(job.epochs.channels) < 3:
        return fixes
    wrong = np.flatnonzero((fixes.worst > gate) & (fixes.freedom > 2))
    best = fixes.worst[wrong].copy()
    repaired = np.zeros(len(wrong), bool)
    for column in range(len(job.epochs.channels)):
        trial = job.angles[wrong].copy()
        trial[:, column] = np.nan
        fresh = locate(trial, *rig, floor_z=floor)
        better = (
            np.isfinite(fresh.position[:, 0])
            & (fresh.worst < np.minimum(best, gate))
            & (fresh.freedom > 0)
        )
        best[better] = fresh.worst[better]
        repaired |= better
        _put(fixes, wrong[better], fresh, better)
    job.reject("station_contradicts_others", np.count_nonzero(repaired))
    return fixes


def _put(fixes: Fixes, rows: NDArray[np.int64], fresh: Fixes, chosen: NDArray[np.bool_]) -> None:
    for name in ("position", "information", "residual", "freedom"):
        getattr(fixes, name)[rows] = getattr(fresh, name)[chosen]


def _noise(fixes: Fixes, good: NDArray[np.bool_]) -> float:
    """Standard deviation of an angle in radians, from what redundancy shows of it.

    Never below the published noise of a standing receiver.
    """
    checked = good & (fixes.freedom > 0)
    if not np.any(checked):
        return COUNT_SIGMA
    residual = fixes.residual[checked]
    seen = np.count_nonzero(np.isfinite(residual), axis=(1, 2))
    inflate = np.sqrt(seen / fixes.freedom[checked])
    return max(COUNT_SIGMA, robust_sigma(residual * inflate[:, None, None]))


def detections(
    epochs: Epochs,
    stations: dict[int, Station],
    residual: Array | None = None,
    good: NDArray[np.bool_] | None = None,
) -> list[dict[str, object]]:
    """What was seen of each station, for ``--json`` (docs/formats.md)."""
    seen = np.isfinite(epochs.counts)
    rows = []
    for i, channel in enumerate(epochs.channels):
        station = stations.get(int(channel))
        used = seen[:, i] if good is None else seen[:, i] & good[:, None]
        row: dict[str, object] = {
            "station": i,
            "channel": int(channel),
            "id": None if station is None or station.id is None else f"{station.id:08x}",
            "period_ticks": int(period_ticks(int(channel))),
            "calibration": "none" if station is None else station.calibration.source,
            "sweeps": int(np.count_nonzero(used)),
            "rejected": int(np.count_nonzero(seen[:, i]) - np.count_nonzero(used)),
        }
        if residual is not None and good is not None:
            row["residual_rad"] = robust_sigma(residual[good][:, i])
        rows.append(row)
    return rows
