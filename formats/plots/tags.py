"""Tags of magnets on the map of a picture: where magnets should lie, and where they were found."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity
from locatk.core.polaris import codec
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.tag import PlanarPose, Tags, as_built_magnets
from locatk.core.solution import Solution
from locatk.formats.sessions.foxglove import tags_in_frames

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Arrows:
    """Magnets on the map: tail and tip of each, (M, 3) in metres."""

    tail: Array
    tip: Array

    @classmethod
    def of(cls, place: Array, angle: Array, length: float, on: PlanarPose) -> Arrows:
        """``place`` (M, 2) and ``angle`` (M,) in the frame that lies at ``on``."""
        c, s = np.cos(on.heading_rad), np.sin(on.heading_rad)
        tail = np.zeros((len(place), 3))
        tail[:, :2] = place @ np.array([[c, s], [-s, c]]) + [on.x_m, on.y_m]
        turn = angle + on.heading_rad
        way = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
        return cls(tail, tail + length * way)

    def moved(self, to: Similarity) -> Arrows:
        """The same in another frame."""
        return Arrows(to.apply(self.tail), to.apply(self.tip))


@dataclass(frozen=True)
class Tag:
    """A tag on the map: its magnets as they should lie, and as they were found."""

    name: str
    frame: str
    known: Arrows
    found: tuple[Arrows, ...]

    def moved(self, to: Similarity) -> Tag:
        """The same in another frame."""
        found = tuple(arrows.moved(to) for arrows in self.found)
        return replace(self, known=self.known.moved(to), found=found)


def tags_of(solution: Solution) -> tuple[Tag, ...]:
    """The tags whose place in the frame of the poses is known."""
    tags = solution.artifact
    if not isinstance(tags, Tags):
        return ()
    length = tags.spacing_m / 3
    drawn = []
    for number, frame, on in tags_in_frames(tags, solution.trajectories):
        place, angle = as_built_magnets(tags, number, codec.layout_of(tags, number))
        found = tuple(
            _found(seen, length, on) for seen in solution.detections if seen.tag_id == number
        )
        drawn.append(Tag(f"tag {number}", frame, Arrows.of(place, angle, length, on), found))
    return tuple(drawn)


def _found(seen: TagDetection, length: float, on: PlanarPose) -> Arrows:
    """Return the magnets of one detection, which are in the array's frame."""
    array, magnets = seen.array_pose, seen.magnets
    assert array is not None  # of a tag that was read
    place = np.array([[m.x_m, m.y_m] for m in magnets])
    angle = np.array([m.angle_rad for m in magnets])
    at = PlanarPose(array.x_m, array.y_m, array.heading_rad)
    in_tag = Arrows.of(place, angle, length, at)
    heading = np.arctan2(*(in_tag.tip - in_tag.tail).T[1::-1])
    return Arrows.of(in_tag.tail[:, :2], heading, length, on)
