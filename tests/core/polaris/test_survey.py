"""Survey of tags: errors agree with covariances, faults are named, the gauge is as said."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from locatk.core import polaris
from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading, wrap_angle
from locatk.core.polaris.design.site import grid_points, place_tags
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.simulation.options import SimulationOptions
from locatk.core.polaris.simulation.session import simulate
from locatk.core.polaris.survey import SurveyDrive, SurveyReport, read_drive, survey
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.core.trajectory import Trajectory

Array = np.ndarray

SITE = {
    1: PlanarPose(0.0, 0.0, 0.0),
    2: PlanarPose(1.5, 0.1, 2.0),
    3: PlanarPose(1.4, 1.3, -1.0),
    4: PlanarPose(-0.2, 1.2, 0.5),
    5: PlanarPose(0.7, 0.6, 3.0),
}
SIGMA = np.array([3e-4, 2e-4, math.radians(0.2)])


def detection(tag_id: int, time_s: float, pose: Array) -> TagDetection:
    return TagDetection(
        time_s, "bar", tag_id, 3.0, None, *pose.tolist(), *SIGMA.tolist(), None, (), 1.0, 0.01,
        0.1, 1.0, 0, 0, 0,
    )  # fmt: skip


def drive(
    rng: np.random.Generator,
    route: Sequence[int],
    *,
    name: str = "drive",
    scale: float = 0.0,
    drift: float = 0.0,
    noise: float = 1.0,
    slip_rad: float = 0.0,
    swapped: dict[int, int] | None = None,
) -> SurveyDrive:
    """A drive in centimetre steps with errors of odometry in each step, independent of the solver.

    ``slip_rad`` rotates the odometry in the middle; ``swapped`` replaces ids at visits.
    """
    corners = np.array([[SITE[tag_id].x_m, SITE[tag_id].y_m] for tag_id in route])
    corners = corners + rng.normal(scale=0.02, size=corners.shape)
    points, visits = [], []
    for start, end in itertools.pairwise(corners):
        visits.append(len(points))
        count = int(np.hypot(*(end - start)) / 0.01)
        points += list(start + (end - start) * np.arange(count)[:, None] / count)
    visits.append(len(points))
    points += [corners[-1], corners[-1] + 0.01]
    position = np.array(points)
    heading = np.unwrap(np.arctan2(*np.gradient(position, axis=0).T[::-1]))
    true = np.column_stack([position, heading])
    odometry = [np.array([5.0, -3.0, rng.uniform(-3, 3)])]
    for k, (before, after) in enumerate(itertools.pairwise(true)):
        motion = relative(before, after)
        length = math.hypot(*motion[:2])
        driven = length + 0.1 * abs(motion[2])
        motion[:2] = motion[:2] * (1 + scale) + 2e-3 * noise * driven**0.5 * rng.normal(size=2)
        motion[2] += drift * length + math.radians(noise) * driven**0.5 * rng.normal()
        motion[2] += slip_rad if k == len(true) // 2 else 0.0
        odometry.append(moved(odometry[-1], motion))
    reported = np.array(odometry)
    time_ns = 10**9 + 50_000_000 * np.arange(len(true), dtype=np.int64)
    path = Trajectory(
        "bar",
        "odom",
        time_ns,
        np.column_stack([reported[:, :2], np.zeros(len(true))]),
        quaternion_from_heading(reported[:, 2]),
        np.full((len(true), 6, 6), np.nan),
    )
    detections = []
    for number, (tag_id, k) in enumerate(zip(route, visits, strict=True)):
        site = SITE[tag_id]
        pose = relative(true[k], np.array([site.x_m, site.y_m, site.heading_rad]))
        shown = (swapped or {}).get(number, tag_id)
        noisy = pose + SIGMA * rng.normal(size=3)
        detections.append(detection(shown, 1e-9 * float(time_ns[k]), noisy))
    result, left_out = read_drive(name, detections, path)
    assert not left_out
    assert result is not None
    return result


def moved(pose: Array, motion: Array) -> Array:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = motion[:2]
    return np.array([pose[0] + c * x - s * y, pose[1] + s * x + c * y, pose[2] + motion[2]])


def relative(pose: Array, other: Array) -> Array:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = other[:2] - pose[:2]
    return np.array([c * x + s * y, c * y - s * x, other[2] - pose[2]])


ROUTES = ((1, 2, 3, 4, 1, 5, 3), (3, 5, 1, 4, 3, 2), (2, 1, 5, 4, 3), (4, 5, 2, 3, 1, 2))


def drives(rng: np.random.Generator, **more: float) -> list[SurveyDrive]:
    return [drive(rng, route, name=f"run{k}", **more) for k, route in enumerate(ROUTES)]


def errors(report: SurveyReport, fixed: PlanarPose = SITE[1]) -> tuple[Array, Array]:
    """Errors (n, 3) of the tags that are not fixed, and their covariances."""
    frame = np.array([fixed.x_m, fixed.y_m, fixed.heading_rad])
    error, covariance = [], []
    for each in report.surveyed:
        if not each.is_fixed:
            site = SITE[each.tag_id]
            true = relative(frame, np.array([site.x_m, site.y_m, site.heading_rad]))
            pose = each.pose
            error.append(np.array([pose.x_m, pose.y_m, pose.heading_rad]) - true)
            covariance.append(each.covariance)
    result = np.array(error)
    result[:, 2] = wrap_angle(result[:, 2])
    return result, np.array(covariance)


def nees(report: SurveyReport) -> float:
    error, covariance = errors(report)
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return float(np.mean(np.einsum("ni,ni->n", error, solved)) / 3)


@pytest.mark.slow
def test_errors_agree_with_covariances() -> None:
    """NEES of 30 surveys with random systematic errors of the odometry, also of a worse one."""
    for noise, limit in ((1.0, 1.3), (3.0, 1.5)):  # the usual noise has a weight
        values = []
        for seed in range(30):
            rng = np.random.default_rng([seed, int(noise)])
            scale, drift = rng.normal() * 0.02, rng.normal() * math.radians(1.0)
            report = survey(
                Tags(),
                drives(rng, scale=scale, drift=drift, noise=noise),
                fixed_ids=(1,),
            )
            assert not report.left_out
            values.append(nees(report))
        assert 0.7 < np.mean(values) < limit


def test_one_survey() -> None:
    report = survey(Tags(), drives(np.random.default_rng(1), scale=0.01))
    assert report.gauge == "tag 1 is at the origin, with its x along the x of the site"
    first = report.surveyed[0]
    assert first.is_fixed
    assert first.pose == PlanarPose(0.0, 0.0, 0.0)
    assert not first.covariance.any()
    error, covariance = errors(report)
    assert np.abs(error[:, :2]).max() < 0.05
    assert np.abs(error[:, 2]).max() < math.radians(2)
    assert (np.diagonal(covariance, axis1=1, axis2=2) > 0).all()
    assert [each.passes for each in report.surveyed] == [5, 5, 6, 4, 4]
    assert report.drives == 4
    assert set(report.tags.site) == set(SITE)
    assert set(report.tags.site_sigma) == set(SITE) - {1}
    assert report.tags.site_sigma[2] == pytest.approx(np.sqrt(np.diag(covariance[0])))
    assert not report.left_out


def test_two_fixed_tags_determine_the_scale() -> None:
    known = Tags(site={1: SITE[1], 3: SITE[3]})
    rng = np.random.default_rng(2)
    free = survey(known, drives(rng, scale=0.03), fixed_ids=(1,))
    rng = np.random.default_rng(2)
    fixed = survey(known, drives(rng, scale=0.03), fixed_ids=(1, 3))
    assert fixed.scale["bar"] == pytest.approx(0.03, abs=4 * fixed.scale_sigma["bar"])
    assert fixed.scale_sigma["bar"] < 0.3 * free.scale_sigma["bar"]
    assert fixed.tags.site[3] == SITE[3]
    assert fixed.gauge == "tags 1, 3 as on the given site"
    assert np.trace(fixed.surveyed[1].covariance) < np.trace(free.surveyed[1].covariance)


def test_the_start_fixes_the_frame() -> None:
    runs = drives(np.random.default_rng(3))
    report = survey(Tags(), runs, fix_start=True)
    assert report.gauge == "the array is at the origin at the start of run0"
    assert not any(each.is_fixed for each in report.surveyed)
    # The first drive starts above tag 1, to centimetres.
    first = report.surveyed[0]
    assert math.hypot(first.pose.x_m, first.pose.y_m) < 0.1
    assert np.allclose([first.pose.x_m, first.pose.y_m], runs[0].visits[0].pose[:2], atol=2e-3)


def test_an_id_that_is_wrong_in_one_drive_is_found() -> None:
    rng = np.random.default_rng(4)
    runs = drives(rng)
    runs[2] = drive(rng, ROUTES[2], name="wrong", swapped={1: 3})
    report = survey(Tags(), runs, fixed_ids=(1,))
    (reason,) = report.left_out.items()
    assert reason[0] == "wrong"
    assert reason[1].startswith("contradicts the other drives, most from tag ")
    assert " tag 3 at " in reason[1]
    assert report.drives == 3
    assert nees(report) < 5
    error, _ = errors(report)
    assert np.abs(error[:, :2]).max() < 0.05


def test_odometry_that_slipped_is_found() -> None:
    rng = np.random.default_rng(5)
    runs = drives(rng)
    runs[0] = drive(rng, ROUTES[0], name="slipped", slip_rad=math.radians(15))
    report = survey(Tags(), runs)
    assert list(report.left_out) == ["slipped"]
    # The frame is that of the first tag of the first drive that is used.
    assert "tag 3 is at the origin" in report.gauge


def test_no_drive_is_excluded_by_chance() -> None:
    for seed in range(10):
        rng = np.random.default_rng([9, seed])
        report = survey(Tags(), drives(rng, drift=math.radians(rng.normal())))
        assert not report.left_out


def test_of_two_drives_neither_is_wrong() -> None:
    rng = np.random.default_rng(6)
    runs = [
        drive(rng, (1, 2, 3), name="one"),
        drive(rng, (1, 2, 3), name="two", slip_rad=1.0),
    ]
    with pytest.raises(InputError, match="one and two contradict each other"):
        survey(Tags(), runs)


def test_two_tags_of_one_id_are_named() -> None:
    rng = np.random.default_rng(7)
    route = (1, 2, 3, 4, 1, 2, 3, 4, 5, 1)
    swapped = {3: 2, 7: 2}  # tag 4 has the id of tag 2
    runs = [drive(rng, route, name=f"run{k}", swapped=swapped, noise=0.1) for k in range(3)]
    with pytest.raises(InputError, match="most those over tag 2"):
        survey(Tags(), runs)


def test_tags_that_nothing_connects_are_left_out() -> None:
    rng = np.random.default_rng(8)
    runs = [drive(rng, (1, 2, 1), name="west"), drive(rng, (3, 4, 3), name="east")]
    report = survey(Tags(), runs)
    assert sorted(report.tags.site) == [1, 2]
    assert report.redundancy == 6  # each part has a frame of its own
    assert report.left_out == {
        "tag 3": "no drive leads from it to a fixed tag",
        "tag 4": "no drive leads from it to a fixed tag",
    }


def test_a_tag_passed_once_is_noted() -> None:
    rng = np.random.default_rng(10)
    runs = [drive(rng, (1, 2, 1, 2)), drive(rng, (2, 1, 5), name="more")]
    report = survey(Tags(), runs)
    assert any("passed only once" in note and note.endswith(": 5") for note in report.notes)
    assert any("three or more" in note for note in report.notes)


def test_tags_of_the_site_that_were_not_passed() -> None:
    rng = np.random.default_rng(11)
    runs = [drive(rng, (1, 2, 1))]
    known = Tags(site={1: PlanarPose(1.0, 2.0, 0.3), 9: PlanarPose(5.0, 5.0, 0.0)})
    kept = survey(known, runs)
    assert kept.tags.site[9] == known.site[9]
    assert kept.tags.site[1] == known.site[1]
    dropped = survey(known, runs, fixed_ids=(2,))
    assert sorted(dropped.tags.site) == [1, 2]
    assert any("are left out" in note for note in dropped.notes)


def test_what_cannot_be_fixed() -> None:
    runs = [drive(np.random.default_rng(12), (1, 2, 1))]
    with pytest.raises(InputError, match="tag 9 was not passed"):
        survey(Tags(), runs, fixed_ids=(9,))
    with pytest.raises(InputError, match="has no pose"):
        survey(Tags(), runs, fixed_ids=(1, 2))
    with pytest.raises(InputError, match=r"no drive can be used \(a: no odometry\)"):
        survey(Tags(), [], {"a": "no odometry"})


def test_passes_that_cannot_be_used_are_named() -> None:
    time_ns = 10**9 * np.arange(1, 4, dtype=np.int64)
    path = Trajectory.from_positions("bar", "odom", time_ns, np.zeros((3, 3)))
    pose = np.zeros(3)
    read = [detection(1, 1.5, pose), detection(2, 2.5, pose)]
    unread = replace(read[0], tag_id=None, refused="tie", time_s=2.0)
    late = replace(read[0], time_s=9.0)
    result, left_out = read_drive("run", [*read, unread, late], path)
    assert result is not None
    assert [visit.tag_id for visit in result.visits] == [1, 2]
    assert left_out == {
        "run at 1.000 s": "not read: tie",
        "run at 8.000 s": "no odometry at that time",
    }
    none, left_out = read_drive("run", read[:1], path)
    assert none is None
    assert left_out["run"] == "1 passes over tags with odometry; a drive needs two"
    assert read_drive("run", read, None) == (None, {"run": "no odometry"})


@pytest.mark.slow
def test_survey_of_simulated_recordings() -> None:
    """Fields by cylinders, passes by the solver, odometry by the simulator."""
    values = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        design = place_tags(Tags(), grid_points(2, 2, 0.7))
        ids = list(design.site)
        site = {
            tag_id: replace(pose, heading_rad=float(rng.uniform(-3, 3)))
            for tag_id, pose in design.site.items()
        }
        scale = float(rng.normal() * 0.02)
        runs, reasons = [], {}
        for k in range(3):
            route = (*rng.permutation(ids).tolist(),) * 2
            options = SimulationOptions(
                route=route, odometry=True, odometry_scale=scale, seed=10 * seed + k, speed_mps=0.2
            )
            session = simulate(replace(design, site=site), options)
            assert session.odometry is not None
            known = replace(design, site={})
            solution = polaris.solve([session.samples], known, odometry=[session.odometry])
            run, left_out = read_drive(f"run{k}", solution.detections, session.odometry)
            assert run is not None
            runs.append(run)
            reasons |= left_out
        report = survey(replace(design, site={}), runs, fixed_ids=(ids[0],))
        assert not report.left_out
        fixed = site[ids[0]]
        frame = np.array([fixed.x_m, fixed.y_m, fixed.heading_rad])
        for each in report.surveyed:
            if each.is_fixed:
                continue
            pose = site[each.tag_id]
            error = np.array([each.pose.x_m, each.pose.y_m, each.pose.heading_rad])
            error -= relative(frame, np.array([pose.x_m, pose.y_m, pose.heading_rad]))
            error[2] = wrap_angle(error[2])
            assert math.hypot(*error[:2]) < 0.06
            values.append(error @ np.linalg.solve(each.covariance, error) / 3)
    # The simulated odometry has no drift, which the covariance allows for.
    assert 0.1 < np.mean(values) < 1.5
