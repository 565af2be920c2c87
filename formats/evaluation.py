"""Evaluation of files: poses and truth are found, read, paired and compared.

Several estimates are compared each with its own truth; runs of the same sessions, such as those of
two methods, are compared with each other by paired differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from locatk.core.errors import InputError, LocatkError, MissingDataError
from locatk.core.evaluation import Evaluation, EvaluationOptions, evaluate, pair_devices
from locatk.core.natural_order import natural_key
from locatk.formats.files import split_selection
from locatk.formats.importers.poses import trajectories as files
from locatk.formats.importers.poses.rosbag import is_bag_folder

TRUTH_ENDINGS = (".mcap", ".tum", ".csv", ".txt", ".kitti", ".tsv", ".db3", ".bag")
"""Endings of files with truth in a folder, in the order in which they are looked for."""

SOLVED_ENDING = "-solved"
"""What ``locatk solve`` appends to the name of a session."""

COLUMNS = (
    "run",
    "session",
    "device",
    "system",
    "method",
    "poses",
    "coverage",
    "median_m",
    "mean_m",
    "rmse_m",
    "p95_m",
    "max_m",
    "rotation_median_deg",
    "rotation_p95_deg",
    "nees",
)
"""Columns of the table of several evaluations, one row for each device: absolute errors, and NEES
per degree of freedom. The coverage is that of all devices of the session."""


@dataclass(frozen=True)
class EvaluatedFile:
    """Errors of the poses of one file.

    Attributes
    ----------
    estimate, truth : Path
    evaluation : Evaluation
    facts : mapping of str to str
        Metadata of a solution: system, method, source.
    notes, warnings : tuple of str
        Assumptions about names, frames and times.
    """

    estimate: Path
    truth: Path
    evaluation: Evaluation
    facts: Mapping[str, str]
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def session(self) -> str:
        """Name of the session that the poses were estimated from."""
        return session_name(self.estimate, self.facts)

    def rows(self, run: str) -> list[dict[str, Any]]:
        """Return a row of the table (:data:`COLUMNS`) for each device."""
        evaluation, rows = self.evaluation, []
        for index, device in enumerate(evaluation.devices):
            statistics = evaluation.device_statistics(index)
            distance, angle = statistics["ape_translation"], statistics["ape_rotation"]
            is_known = (evaluation.device == index) & np.isfinite(evaluation.nees)
            dof = int(np.sum(evaluation.nees_dof[is_known]))
            rows.append(
                {
                    "run": run,
                    "session": self.session,
                    "device": device,
                    "system": self.facts.get("system", ""),
                    "method": self.facts.get("method", ""),
                    "poses": 0 if distance is None else distance.n,
                    "coverage": evaluation.coverage.fraction,
                    "median_m": distance and distance.median,
                    "mean_m": distance and distance.mean,
                    "rmse_m": distance and distance.rmse,
                    "p95_m": distance and distance.p95,
                    "max_m": distance and distance.max,
                    "rotation_median_deg": angle and angle.median,
                    "rotation_p95_deg": angle and angle.p95,
                    "nees": float(np.sum(evaluation.nees[is_known]) / dof) if dof else None,
                }
            )
        return sorted(rows, key=lambda row: natural_key(row["device"]))


@dataclass(frozen=True)
class RunSummary:
    """Errors of all sessions of a run, and its difference from the first run.

    Attributes
    ----------
    run : str
    sessions, poses : int
    median_m, mean_m, rmse_m, p95_m, max_m : float
        Of all poses together.
    shared : int
        Number of sessions that are in the first run as well.
    difference_m : float or None
        Median over these of the difference of the median errors, this run minus the first.
    better : int
        Number of these in which the median error is smaller than that of the first run.
    """

    run: str
    sessions: int
    poses: int
    median_m: float
    mean_m: float
    rmse_m: float
    p95_m: float
    max_m: float
    shared: int = 0
    difference_m: float | None = None
    better: int = 0


def evaluate_file(
    estimate: Path,
    truth: Path,
    options: EvaluationOptions,
    *,
    names: Mapping[str, str] | None = None,
    match: str = "auto",
    role: files.Role = "estimate",
) -> EvaluatedFile:
    """Compare the poses of a file with those of another one.

    Parameters
    ----------
    estimate, truth : Path
        See :func:`locatk.formats.importers.poses.trajectories.open_file`.
    options : EvaluationOptions
    names : mapping of str to str, optional
        Device in the truth of each device of the estimate.
    match : str
        As in the options, or ``"auto"``: ``"nearest"`` if both files are TUM or KITTI, else
        ``"interpolate"``.
    role : str
        Poses of ``estimate`` to compare: ``"estimate"``, ``"onboard"`` or ``"live"``.

    Raises
    ------
    InputError
        A file has no poses, or no device of the estimate has truth.
    LocatkError
        See the readers and :func:`locatk.core.evaluation.evaluate`.
    """
    estimated = files.open_file(estimate, role=role)
    true = files.open_file(truth, role="truth")
    files.check_kinds(estimated, true)
    notes, warnings = [*estimated.notes, *true.notes], []
    if not estimated.solved:
        if estimated.path.samefile(true.path):
            raise InputError(
                "no solved poses", file=estimate, hint="Solve it first: `locatk solve`"
            )
        warnings.append(f"{estimate} has no solved poses: its truth is used as the estimate")
    names = names or {}
    pairs, unpaired = pair_devices(estimated.trajectories, true.trajectories, dict(names))
    if not pairs:
        estimated_devices, true_devices = (
            ", ".join(each.device for each in side.trajectories) for side in (estimated, true)
        )
        raise InputError(
            f"none of its devices is in {truth}",
            file=estimate,
            hint=f"Name the pairs by --pair NAME=NAME: one of {estimated_devices}, and one of "
            f"{true_devices}. FILE#NAME reads one of them only",
        )
    # TUM and KITTI files do not name their device.
    has_names = not {estimated.kind, true.kind} & set(files.EVO_KINDS)
    for track, reference in pairs:
        device = track.device
        if has_names and reference.device != device and device not in names:
            notes.append(f"{device} is compared with {reference.device}, the only other device")
        frames = {track.frame, reference.frame} - {""}
        if options.align == "none" and len(frames) > 1:
            warnings.append(
                f"the poses of {device} are in the frame {track.frame!r}, its truth in "
                f"{reference.frame!r}: unless they are the same, errors need --align"
            )
    if unpaired:
        warnings.append(f"no truth for {', '.join(unpaired)}")
    if match == "auto":
        is_evo = estimated.kind in files.EVO_KINDS and true.kind in files.EVO_KINDS
        match = "nearest" if is_evo else "interpolate"
    # KITTI has no times: its rows are one second apart.
    max_gap_s = max(1.0, options.max_gap_s) if estimated.kind == "kitti" else options.max_gap_s
    evaluation = evaluate(pairs, replace(options, match=match, max_gap_s=max_gap_s))
    if evaluation.time_offset.coarse_method == "first stamps":
        warnings.append(
            "the motions differ too much to estimate the time offset: the first stamps were matched"
        )
    if evaluation.time_offset.alternatives:
        warnings.append("the motion is periodic and fits several time offsets: give --offset")
    facts = _read_facts(estimated.path) if estimated.kind in ("solution", "session") else {}
    return EvaluatedFile(estimate, truth, evaluation, facts, tuple(notes), tuple(warnings))


def find_estimates(names: Sequence[Path]) -> tuple[list[Path], bool]:
    """Return the files of paths, folders and patterns, and whether one name can mean several.

    A folder stands for its solutions, and for damaged files, unless it is a bag of ROS.

    Raises
    ------
    MissingDataError
        A name has no file, or a folder has no solution.
    """
    found: dict[Path, None] = {}
    is_several = len(names) > 1
    for name in names:
        file = split_selection(name)[0]
        # A plain file needs no search, whose imports take long.
        is_one = file != name or file.is_file() or is_bag_folder(file)
        expanded = None if is_one else _expand(str(name))
        if expanded is None:
            found[name] = None
            continue
        is_several = True
        candidates = [Path(file) for file in expanded]
        if name.is_dir():
            candidates = [file for file in candidates if _may_be_solution(file)]
            if not candidates:
                raise MissingDataError(
                    "no solution in the folder", file=name, hint="Solve it: `locatk solve`"
                )
        found.update(dict.fromkeys(candidates))
    return list(found), is_several


def find_truth(estimate: Path, truth: Path) -> Path:
    """Return the file with the truth of an estimate: ``truth``, or that of its name in a folder.

    In a folder, it has the name of the session of a solution, or that of the estimate, with or
    without ``-solved``. It can be the folder of a bag of ROS.

    Raises
    ------
    MissingDataError
        There is no such file.
    """
    if not truth.is_dir() or is_bag_folder(truth):
        return truth
    stems = dict.fromkeys(
        (
            session_name(estimate, _read_facts(estimate)),
            base_name(estimate),
            split_selection(estimate)[0].stem,
        )
    )
    for stem in stems:
        for ending in TRUTH_ENDINGS:
            candidate = truth / f"{stem}{ending}"
            if candidate.is_file() and not candidate.samefile(split_selection(estimate)[0]):
                return candidate
        if is_bag_folder(truth / stem):
            return truth / stem
    raise MissingDataError(
        f"no truth of this name in {truth}",
        file=estimate,
        hint=f"Expected {next(iter(stems))} with {', '.join(TRUTH_ENDINGS)}",
    )


def session_name(estimate: Path, facts: Mapping[str, str]) -> str:
    """Return the name of the session of an estimate, without ending."""
    source = facts.get("source", "")
    return Path(source).stem if source else base_name(estimate)


def _expand(name: str) -> list[str] | None:
    from locatk.formats.pipeline.file_search import expand_name

    return expand_name(name)


def _may_be_solution(path: Path) -> bool:
    """Return whether a file is a solution, or damaged: it is then named when it is read."""
    from locatk.formats.sessions.reader import Session

    try:
        return Session.open(path).facts.get("kind") == "solution"
    except LocatkError:
        return True


def _read_facts(path: Path) -> dict[str, str]:
    # Text files are evaluated without the library of MCAP, which takes long to import.
    if path.suffix.lower() != ".mcap":
        return {}
    from locatk.formats.pipeline.session_search import read_facts

    return read_facts(str(path))


def base_name(estimate: Path) -> str:
    """Return the name of a file without ending and without ``-solved``."""
    return split_selection(estimate)[0].stem.removesuffix(SOLVED_ENDING)


def label_runs(evaluated: Sequence[EvaluatedFile]) -> list[str]:
    """Return the run of each file: what tells files of the same session apart.

    It is the folder, or the method, or the name of the file; empty if no session occurs twice.
    """
    sessions = [each.session for each in evaluated]
    if len(set(sessions)) == len(sessions):
        return [""] * len(sessions)
    folders = [str(each.estimate.parent) for each in evaluated]
    for labels in (folders, [each.facts.get("method", "") for each in evaluated]):
        if len(set(zip(sessions, labels, strict=True))) == len(sessions):
            return labels
    return [str(each.estimate) for each in evaluated]


def summarize_runs(evaluated: Sequence[EvaluatedFile], runs: Sequence[str]) -> list[RunSummary]:
    """Return a summary of each run, the first of which the others are compared with."""
    by_run: dict[str, dict[str, Evaluation]] = {}
    for each, run in zip(evaluated, runs, strict=True):
        by_run.setdefault(run, {})[each.session] = each.evaluation
    first = next(iter(by_run.values()))
    summaries = []
    for run, own in by_run.items():
        errors = np.concatenate([evaluation.errors for evaluation in own.values()])
        summary = RunSummary(
            run,
            len(own),
            len(errors),
            float(np.median(errors)),
            float(np.mean(errors)),
            float(np.sqrt(np.mean(errors**2))),
            float(np.percentile(errors, 95)),
            float(np.max(errors)),
        )
        shared = [name for name in own if name in first] if own is not first else []
        if shared:
            change = np.array([own[name].median - first[name].median for name in shared])
            summary = replace(
                summary,
                shared=len(shared),
                difference_m=float(np.median(change)),
                better=int(np.count_nonzero(change < 0)),
            )
        summaries.append(summary)
    return summaries
