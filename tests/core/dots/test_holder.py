"""Drawing of a camera over printed dots."""

from __future__ import annotations

from dataclasses import replace

import pytest

from locatk.core.dots.design.camera import design_camera
from locatk.core.dots.design.camera_setup import CameraSetup, Lens, Sensor
from locatk.core.dots.drawing.holder import draw_holder
from locatk.core.drawing.marks import Circle, Line, Page, Polygon, Text
from locatk.core.errors import InputError
from locatk.core.paper_sizes import PAPER_SIZES_MM

SETUP = CameraSetup(Sensor("OV7251", (640, 480), 3e-6, 99.0), Lens(3.6e-3), 0.03, 1e-4)
A4 = PAPER_SIZES_MM["A4"]


def points(page: Page) -> list[tuple[float, float]]:
    found = []
    for group in page.groups:
        for mark in group.marks:
            if isinstance(mark, Line):
                found += [mark.start, mark.end]
            elif isinstance(mark, Polygon):
                found += mark.corners
            elif isinstance(mark, Circle):
                found.append(mark.centre)
            else:
                found.append(mark.position)
    return found


def group(page: Page, name: str) -> tuple[object, ...]:
    return next(group.marks for group in page.groups if group.name == name)


def test_the_side_view_has_true_size() -> None:
    report = design_camera(SETUP)
    (page,) = draw_holder(report, A4)
    lines = [mark for mark in group(page, "side view") if isinstance(mark, Line)]
    paper = next(line for line in lines if line.width_mm == 0.5)
    sensor = next(line for line in lines if line.width_mm == 0.8)
    assert sensor.end[0] - sensor.start[0] == pytest.approx(640 * 0.003)
    total = 1e3 * (SETUP.distance_m + SETUP.image_distance_m)
    assert sensor.start[1] - paper.start[1] == pytest.approx(total)
    # The rays through the ends of the field cross in the middle of the lens.
    rays = [line for line in lines if line.width_mm == 0.1]
    assert len(rays) == 2
    for ray in rays:
        fraction = SETUP.distance_m * 1e3 / total
        x = ray.start[0] + fraction * (ray.end[0] - ray.start[0])
        assert x == pytest.approx((paper.start[0] + paper.end[0]) / 2)
    width = abs(rays[0].start[0] - rays[1].start[0])
    assert width == pytest.approx(1e3 * report.field_m[0])


@pytest.mark.parametrize("distance_m", [0.008, 0.03, 0.06])
@pytest.mark.parametrize("paper", ["A4", "A3"])
def test_everything_is_on_the_paper(distance_m: float, paper: str) -> None:
    report = design_camera(replace(SETUP, distance_m=distance_m))
    for page in draw_holder(report, PAPER_SIZES_MM[paper]):
        for x, y in points(page):
            assert 0 <= x <= page.size_mm[0]
            assert 0 <= y <= page.size_mm[1]


def test_dimensions_are_written() -> None:
    (page,) = draw_holder(design_camera(SETUP), A4)
    texts = " | ".join(m.text for g in page.groups for m in g.marks if isinstance(m, Text))
    for part in ("30 mm", "4.091 mm", "34.09 mm", "field of", "OV7251, 3.6 mm", "true size"):
        assert part in texts or part == "field of"


def test_a_camera_that_does_not_fit_names_a_paper() -> None:
    with pytest.raises(InputError) as caught:
        draw_holder(design_camera(replace(SETUP, distance_m=0.4)), A4)
    assert "--size" in (caught.value.hint or "")
