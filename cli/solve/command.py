"""``locatk solve``: sessions in, poses out."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section
from locatk.cli.solve import text as solve_text

if TYPE_CHECKING:
    from locatk.core.errors import LocatkError
    from locatk.formats.pipeline import Outcome, SolveFailure, SolveJob, SolveReport

SCENES = ("auto", "one-planar", "two-planar", "two-3d")

MIN_RATE_HZ, MAX_RATE_HZ = 0.1, 10_000.0
"""Smallest and largest number of poses per second."""

BAR_CHARACTERS = 30
"""Length of the progress bar of a batch."""

scene_option = click.option(
    "--scene",
    type=click.Choice(SCENES),
    default=None,
    help="Lighthouse: assumed number and geometry of stations.  [default: auto, from the data]",
)


class TemplateResolution(click.ParamType):
    """Numbers of orientations, lateral offsets and points of templates, as in ``36,5,80``."""

    name = "resolution"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the three numbers without spaces."""
        numbers = [number.strip() for number in str(value).split(",")]
        if len(numbers) != 3 or not all(number.isdecimal() for number in numbers):
            self.fail(f"{value!r} is not of the form 36,5,80", param, ctx)
        return ",".join(str(int(number)) for number in numbers)


speed_option = click.option(
    "--speed",
    type=options.PositiveNumber(1e-9, 100),
    metavar="M/S",
    help="Polaris: speed of the array over the tags, if it is known.",
)

templates_option = click.option(
    "--templates",
    type=TemplateResolution(),
    metavar="ORIENTATIONS,OFFSETS,POINTS",
    help="Polaris with --method paper: resolution of the templates. Number of "
    "orientations in 360 deg, of lateral offsets within half a sensor spacing to "
    "either side, and of points per template, which extends one tag spacing before "
    "and behind the magnet.  [default: 36,5,80]",
)


odometry_noise_option = click.option(
    "--odometry-noise",
    type=options.PositiveNumber(1e-9, 90),
    metavar="DEG",
    help="Landmarks: random walk of the heading by odometry, in deg per square root of a metre.  "
    "[default: estimated]",
)

odometry_lag_option = click.option(
    "--odometry-lag",
    type=click.FloatRange(min=-1000, max=1000),
    metavar="MS",
    help="Landmarks: time by which odometry is later than the hall sensors, in milliseconds.  "
    "[default: estimated]",
)


class PoseRate(click.ParamType):
    """Poses per second, or the word ``sweeps`` for a pose at the time of each sweep."""

    name = "rate"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text of a valid rate."""
        try:
            is_valid = value == "sweeps" or MIN_RATE_HZ <= float(value) <= MAX_RATE_HZ
        except ValueError:
            is_valid = False
        if not is_valid:
            limits = f"{MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz"
            self.fail(f"{value!r} is neither a rate of {limits} nor the word sweeps", param, ctx)
        return str(value)


rate_option = click.option(
    "--rate",
    type=PoseRate(),
    metavar="HZ|sweeps",
    help="Lighthouse: poses per second of devices that move, or one at the time of each sweep.  "
    "[default: one per rotation of a station]",
)


def _jobs(ctx: click.Context, param: click.Parameter, value: str) -> int:
    """Convert a number of processes; 0 stands for one per core."""
    if value != "auto" and not value.isdecimal():
        raise click.BadParameter("give a number, or auto for one per core")
    return 0 if value == "auto" else int(value)


@click.command(cls=Command, short_help="Estimate poses from recorded sessions.")
@click.argument("sessions", nargs=-1, required=True)
@click.option(
    "-o",
    "--output",
    metavar="PATH",
    help="Solution to write (.mcap), or folder for the solutions of several sessions; "
    "also a URL.  [default: <session>-solved.mcap in the folder of each session]",
)
@options.method
@options.overwrite
@section(
    "Input",
    options.artifact,
    options.input_option(
        "--camera",
        help="Dots: camera (.toml) to use instead of the session's.",
    ),
    options.input_option(
        "--tag",
        many=True,
        help="Polaris: tags (.toml) to use instead of the session's; several times if the site has "
        "tags of several designs.",
    ),
    scene_option,
    rate_option,
    speed_option,
    templates_option,
    odometry_noise_option,
    odometry_lag_option,
)
@section(
    "Output",
    options.output_option(
        "--save-scene",
        endings=(".toml",),
        metavar="FILE",
        help="Lighthouse: also write the estimated scene (.toml), for --artifact.",
    ),
)
@section(
    "Batch",
    click.option(
        "--jobs",
        metavar="N",
        default="1",
        callback=_jobs,
        help="Number of sessions to solve in parallel; 0 or auto for one per core.  [default: 1]",
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Solve on the Dask cluster of this scheduler, as in tcp://host:8786 (needs "
        "locatk[dask]).",
    ),
    click.option(
        "--resume",
        is_flag=True,
        help="Skip sessions that are solved with the same options and version; replace outdated "
        "solutions.",
    ),
)
@options.json_flag("one JSON object per session, each on a line,")
@options.verbosity
def command(
    sessions: tuple[str, ...],
    output: str | None,
    method: str | None,
    scene: str | None,
    rate: str | None,
    artifact: Path | None,
    camera: Path | None,
    tag: tuple[Path, ...],
    speed: float | None,
    templates: str | None,
    odometry_noise: float | None,
    odometry_lag: float | None,
    save_scene: Path | None,
    jobs: int,
    scheduler: str | None,
    resume: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Estimate the poses of the devices in SESSIONS, and write them to OUTPUT.

    SESSIONS are files, folders (all *.mcap in them except solutions), patterns in quotes,
    and URLs such as s3://bucket/day/*.mcap (extra locatk[s3]). A session that fails does not
    stop the others. With --json, the lines are in the order of the sessions.

    The exit status is 3 if a session could not be solved or is only solved in part: a device
    without a pose, an unread tag, a robot that is not localised on the map, a landmark that
    differs from the map, or more frames or epochs without a pose than with one. The other
    results are written.

    \b
    Examples:
      locatk solve run.mcap -o solved.mcap
      locatk solve run.mcap -o solved.mcap --method paper --json
      locatk solve first.mcap -o solved.mcap --save-scene scene.toml
      locatk solve flight.mcap -o solved.mcap --rate 100
      locatk solve day/*.mcap -o solved/ --artifact scene.toml
      locatk solve day/ -o solved/ --jobs auto --resume --json
      locatk solve "s3://lab/*.mcap" -o s3://lab/out --scheduler tcp://host:8786
      locatk solve frames.mcap -o solved.mcap --camera camera.toml
      locatk solve pass.mcap -o solved.mcap --artifact tag.toml --speed 0.105
      locatk solve pass.mcap --tag small.toml --tag large.toml
      locatk solve pass.mcap --speed 0.105 --method paper --templates 72,9,80
      locatk solve drive.mcap -o solved.mcap --artifact map.toml --method field
    """
    from locatk.formats import pipeline

    if scheduler is not None and jobs != 1:
        raise click.UsageError("--jobs is for this machine: leave it out with --scheduler.")
    if artifact is not None and tag:
        raise click.UsageError(
            "--artifact and --tag both replace the tags of the session: give each file with --tag."
        )
    if save_scene is not None and resume:
        raise click.UsageError("--save-scene cannot be combined with --resume.")
    found = pipeline.find_sessions(sessions, pipeline.default_output if output is None else None)
    for location in found.skipped_solutions:
        console.detail(f"Skipped {location}: a solution")
    names = found.sessions
    if save_scene is not None:
        _check_scene(names)
    input_files = [path for path in (artifact, camera, *tag) if path is not None]
    request = pipeline.SolveRequest(
        method,
        scene,
        artifact,
        camera,
        speed,
        templates,
        tag=tag or None,
        odometry_noise=odometry_noise,
        odometry_lag=odometry_lag,
        rate=None if rate is None else float("inf" if rate == "sweeps" else rate),
    )
    try:
        outputs = pipeline.plan_outputs(names, output, is_folder=found.has_folder)
        if output is not None and outputs == [output]:
            options.check_ending(Path(output.partition("?")[0]), (".mcap",))
        if len(names) > 1:
            pipeline.check_artifacts(request)
        pipeline.check_outputs(
            outputs,
            [*names, *map(str, input_files)],
            overwrite=overwrite,
            resume=resume,
            folder=None if outputs == [output] else output,
        )
    except pipeline.OutputConflictError as error:
        raise click.UsageError(error.message) from None
    if save_scene is not None:
        inputs = [*map(Path, names), *input_files]
        options.guard_output(save_scene, overwrite=overwrite, inputs=inputs)

    work = pipeline.plan_jobs(
        names,
        outputs,
        request,
        overwrite=overwrite,
        resume=resume,
        scene_output=save_scene,
        is_remote=scheduler is not None,
        with_detections=as_json,
    )
    solve = _solve_one if len(work) == 1 else _solve_several
    solve(work, as_json, workers=jobs, scheduler=scheduler)


def _check_scene(sessions: Sequence[str]) -> None:
    """Refuse --save-scene for systems that do not estimate a scene."""
    from locatk.formats.pipeline import session_search, systems

    if len(sessions) > 1:
        raise click.UsageError("--save-scene needs exactly one session.")
    name = session_search.read_facts(sessions[0]).get("system", "")
    system = systems.SYSTEMS.get(name)
    if isinstance(system, systems.System) and not system.estimates_scene:
        raise click.UsageError(f"--save-scene is for lighthouse: {name} estimates no scene.")


def _solve_one(jobs: Sequence[SolveJob], as_json: bool, **workers: Any) -> None:
    """Solve one session; its error or its first loss is the result of the command."""
    from locatk.core import progress
    from locatk.formats import pipeline

    with console.working("Solving") as advance, progress.observed(advance):
        [outcome] = [
            outcome for _, ready in pipeline.solve_batch(jobs, **workers) for outcome in ready
        ]
    if isinstance(outcome, pipeline.SolveFailure):
        console.detail(outcome.traceback.rstrip())
        raise _error(outcome)
    _print_outcome(outcome, jobs[0], as_json)
    losses = [f"{outcome.session}: {loss.message}" for loss in outcome.losses]
    for loss in losses[1:]:
        console.warn(loss)
    if losses:
        raise failures.Incomplete(losses[0])


def _solve_several(jobs: Sequence[SolveJob], as_json: bool, **workers: Any) -> None:
    """Solve sessions, print a line for each, and raise if there were failures or losses.

    Warnings follow, each kind once, and a table of the sessions with failures or losses. Verbose
    output has all details of each session.

    Raises
    ------
    click.ClickException
        No session could be solved.
    Incomplete
        Some sessions could not be solved completely.
    """
    from locatk.formats import pipeline

    total, printed, failed, incomplete = len(jobs), 0, 0, 0
    reports: list[SolveReport] = []
    problems: list[tuple[str, str]] = []
    progress = _BatchProgress(total, as_json)
    try:
        progress.show(0)
        with contextlib.closing(pipeline.solve_batch(jobs, **workers)) as outcomes:
            for done, ready in outcomes:
                progress.erase()
                for outcome in ready:
                    _print_outcome(outcome, jobs[printed], as_json, is_brief=not console.verbose())
                    if isinstance(outcome, pipeline.SolveFailure):
                        failures.print_error(_error(outcome))
                        problems.append((outcome.session, _error(outcome).message))
                        failed += 1
                    else:
                        reports.append(outcome)
                        problems += [(outcome.session, loss.message) for loss in outcome.losses]
                        incomplete += bool(outcome.losses)
                    printed += 1
                progress.show(done)
    except KeyboardInterrupt:
        progress.erase()
        console.say(
            f"Interrupted after {printed} of {total} sessions. Hint: Repeat the command with "
            "--resume to solve the others."
        )
        raise
    progress.erase()
    if not console.verbose():
        for note in solve_text.batch_notes(reports):
            console.say(note)
    if problems and not as_json:
        console.say(solve_text.problem_table(problems))
    if failed == total:
        raise click.ClickException(f"none of the {total} sessions could be solved")
    if failed or incomplete:
        parts = [f"{failed} of {total} sessions could not be solved"] if failed else []
        parts += [f"{incomplete} of {total} are solved in part"] if incomplete else []
        raise failures.Incomplete(", ".join(parts))


def _print_outcome(
    outcome: Outcome, job: SolveJob, as_json: bool, *, is_brief: bool = False
) -> None:
    """Print the result of one session, without its losses; if brief, one line unless quiet."""
    from locatk.formats import pipeline

    if isinstance(outcome, pipeline.SolveFailure):
        if as_json:
            error = _error(outcome)
            failure = {"session": outcome.session, "error": error.message, "hint": error.hint}
            console.emit_json({"version": 1, "sessions": [failure]})
        if outcome.traceback:
            console.detail(outcome.traceback.rstrip())
        return
    if as_json:
        entry = solve_text.json_entry(outcome)
        if job.resume:
            entry["resumed"] = outcome.is_resumed
        console.emit_json({"version": 1, "sessions": [entry]})
    if is_brief:
        if console.talks():
            console.result(solve_text.summary(outcome))
        return
    console.result(solve_text.text(outcome))
    for note in solve_text.notes(outcome):
        console.say(note)


def _error(failure: SolveFailure) -> LocatkError:
    """Return the error of a session, with the hint of the command line on internal errors."""
    if failure.is_internal:
        failure.error.hint = failures.REPORT_HINT
    return failure.error


class _BatchProgress:
    """Progress bar on the last line of a terminal, erased before results are printed."""

    def __init__(self, total: int, as_json: bool) -> None:
        is_terminal = console.talks() and sys.stderr.isatty()
        self._is_shown = is_terminal and not (as_json and sys.stdout.isatty())
        self._total = total

    def show(self, done: int) -> None:
        """Show the number of finished sessions."""
        if self._is_shown:
            full = BAR_CHARACTERS * done // self._total
            bar = "#" * full + "-" * (BAR_CHARACTERS - full)
            console.control(f"\rSolving  [{bar}]  {done}/{self._total}")

    def erase(self) -> None:
        """Erase the bar."""
        if self._is_shown:
            console.erase_line()
