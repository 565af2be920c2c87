"""Simulated floor: tags as built, debris on them, and the Earth's field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.simulation.field import (
    Debris,
    Discs,
    debris_field,
    disc_field,
    earth_field,
    scatter_debris,
)
from locatk.core.polaris.simulation.options import RandomSource, SimulationOptions
from locatk.core.polaris.tag import (
    AsBuiltTag,
    PlanarPose,
    Tags,
    as_built_magnets,
    cell_positions,
    symbol_angles,
)
from locatk.core.simulation import random_stream

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TagFloor:
    """Tags, debris and the Earth.

    Attributes
    ----------
    frame : str
        ``"site"``, or ``"tag-<id>"`` of the only tag.
    site : mapping of int to PlanarPose
        Poses of all tags on the floor.
    route : tuple of int
        Tags to cross, in order.
    discs : Discs
    built : mapping of int to AsBuiltTag
        Deviations of the magnets of each tag from the design.
    debris : Debris
    earth_t : (3,) ndarray
    """

    frame: str
    site: Mapping[int, PlanarPose]
    route: tuple[int, ...]
    discs: Discs
    built: Mapping[int, AsBuiltTag]
    debris: Debris
    earth_t: Array

    def field(self, points_m: Array) -> Array:
        """Return the flux density (..., 3) in tesla at ``points_m`` (..., 3)."""
        magnets_t, debris_t = disc_field(self.discs, points_m), debris_field(self.debris, points_m)
        return np.asarray(magnets_t + debris_t + self.earth_t)


def build_floor(tags: Tags, options: SimulationOptions) -> TagFloor:
    """Build the tags with their errors, and scatter debris over those that are crossed.

    Raises
    ------
    InputError
        A tag of the route is not of the family or not on the site, or the route has several
        tags although there is no site.
    """
    site, route, frame = _arrange_tags(tags, options.route)
    discs, built = _build_tags(tags, site, options)
    earth_t = earth_field(options.earth_t, options.dip_rad, options.north_rad)
    crossed = [site[tag_id] for tag_id in dict.fromkeys(route)]
    debris = _debris_of_tags(tags, crossed, discs, earth_t, options)
    return TagFloor(frame, site, route, discs, built, debris, earth_t)


def to_site_frame(tag_pose: PlanarPose, points: Array) -> Array:
    """Transform points (..., 2) from the frame of a tag to that of the site."""
    cos, sin = np.cos(tag_pose.heading_rad), np.sin(tag_pose.heading_rad)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + [tag_pose.x_m, tag_pose.y_m])


def _arrange_tags(
    tags: Tags, route: tuple[int, ...]
) -> tuple[Mapping[int, PlanarPose], tuple[int, ...], str]:
    """Return the poses of the tags, the tags to cross, and the name of the frame."""
    if tags.site:
        unknown = [tag_id for tag_id in route if tag_id not in tags.site]
        if unknown:
            raise InputError(
                f"tag {unknown[0]} is not on the site",
                hint="The site has " + ", ".join(map(str, tags.site)),
            )
        return tags.site, route or tuple(tags.site), "site"
    first = route[0] if route else (tags.ids or (0,))[0]
    if any(tag_id != first for tag_id in route):
        raise InputError(
            "several tags and no site with their positions",
            hint="Give the tags a site, or cross one of them",
        )
    return {first: PlanarPose(0.0, 0.0, 0.0)}, (first,), f"tag-{first}"


def _build_tags(
    tags: Tags, site: Mapping[int, PlanarPose], options: SimulationOptions
) -> tuple[Discs, dict[int, AsBuiltTag]]:
    """Return the magnets of all tags with their errors, and the same relative to the design."""
    ids: list[int] = []
    positions: list[Array] = []
    directions: list[Array] = []
    strengths: list[Array] = []
    built = {}
    for tag_id, tag_pose in site.items():
        if tags.ids is not None and tag_id not in tags.ids:
            raise InputError(
                f"tag {tag_id} is not of the family", hint=f"It has {len(tags.ids)} members"
            )
        layout = codec.layout_of(tags, tag_id)
        position_m, angle_rad = as_built_magnets(tags, tag_id, layout)
        # A stream for each id: the tag is the same on every site.
        rng = random_stream(options.build_seed, RandomSource.TAG, tag_id)
        position_m = position_m + options.build_place_m * rng.normal(size=position_m.shape)
        angle_rad = angle_rad + options.build_angle_rad * rng.normal(size=angle_rad.shape)
        strengths.append(1 + options.build_strength * rng.normal(size=angle_rad.shape))
        built[tag_id] = AsBuiltTag(
            position_m - cell_positions(tags, layout.cells),
            angle_rad - symbol_angles(tags, layout.symbols),
        )
        ids += [tag_id] * len(position_m)
        positions.append(to_site_frame(tag_pose, position_m))
        directions.append(np.angle(np.exp(1j * (angle_rad + tag_pose.heading_rad))))
    discs = Discs(
        tags.magnet,
        tuple(ids),
        np.vstack(positions),
        np.concatenate(directions),
        np.concatenate(strengths),
    )
    return discs, built


def _debris_of_tags(
    tags: Tags,
    tag_poses: list[PlanarPose],
    discs: Discs,
    earth_t: Array,
    options: SimulationOptions,
) -> Debris:
    """Scatter debris over each tag, and a grid spacing beyond its outer cells."""
    half_width_m = ((tags.order - 1) / 2 + 1) * tags.spacing_m
    rng = random_stream(options.seed, RandomSource.DEBRIS)
    parts = [
        scatter_debris(
            discs,
            np.array([pose.x_m, pose.y_m]) - half_width_m,
            np.array([pose.x_m, pose.y_m]) + half_width_m,
            options.debris,
            options.debris_size_m,
            options.debris_magnetised,
            earth_t,
            rng,
        )
        for pose in tag_poses
    ]
    return Debris(
        np.vstack([part.position_m for part in parts]),
        np.vstack([part.moment_am2 for part in parts]),
    )
