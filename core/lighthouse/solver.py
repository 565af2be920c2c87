"""From sweeps to poses: the road that a session of Lighthouse sweeps takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from locatk.core.errors import DegenerateError, InputError
from locatk.core.lighthouse.devices.solver import rigid_devices, solve_devices
from locatk.core.lighthouse.epochs import group_epochs
from locatk.core.lighthouse.job import Job
from locatk.core.lighthouse.localization import photodiodes as poses
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

SCENES = ("auto", "one-planar", "two-planar", "two-3d")
METHODS = ("bundle", "paper")


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
    receivers: Mapping[str, Receiver] | None = None,
) -> Solution:
    """Poses of all photodiodes and rigid devices in a recording.

    Parameters
    ----------
    sweeps : Sweeps
    scene : Scene, optional
        With stations: they are used as they are. Without: they are solved first; markers
        and distances then fix frame and scale.
    options : SolveOptions, optional
    odometry : sequence of Trajectory
        For the scale, where the scene has neither markers nor distances.
    receivers : mapping of str to Receiver, optional
        By device. Devices with three photodiodes or more of known place get full poses, and
        the scene comes from them where it has no stations; the others are located in it.

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
    rigid = rigid_devices(sweeps, receivers) if receivers else {}
    if rigid and options.method == "bundle":
        return solve_devices(sweeps, scene, options, rigid)
    solution = _solve_points(sweeps, scene, options, odometry)
    if not rigid:
        return solution
    note = "the paper's method knows no rigid devices: each photodiode is solved by itself"
    warnings = (*solution.warnings, SolverWarning("unspecified", note))
    return replace(solution, warnings=warnings)


def _solve_points(
    sweeps: Sweeps, scene: Scene, options: SolveOptions, odometry: Sequence[Trajectory]
) -> Solution:
    """Poses of photodiodes, each by itself."""
    epochs = group_epochs(sweeps)
    if len(epochs) == 0 or len(epochs.channels) == 0:
        raise DegenerateError(
            "the recording has no usable sweep",
            hint="`locatk info` shows what it has; rejected: "
            + (", ".join(f"{n} {r}" for r, n in epochs.rejected.items()) or "nothing"),
        )
    job = Job(epochs, scene, options, odometry)
    if scene.stations:
        known = job.known_scene()
        if options.method == "paper":
            raise InputError(
                "the paper's method solves its own scene and takes none with stations",
                hint="leave --artifact or --method paper out",
            )
        return poses.answer(job, known)
    if options.method == "paper":
        from locatk.core.lighthouse.published.scene_solver import solve_as_paper

        return solve_as_paper(job)
    return poses.answer(job, job.solve_scene())
