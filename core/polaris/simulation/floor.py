"""The floor as it truly is: where tags lie, how they were built, what lies about."""

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
    scatter,
)
from locatk.core.polaris.simulation.options import SimulationOptions
from locatk.core.polaris.tag import (
    AsBuiltTag,
    PlanarPose,
    Tags,
    as_built_magnets,
    cell_positions,
    symbol_angles,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Floor:
    """Tags, debris and the Earth.

    Attributes
    ----------
    frame : str
        ``"site"``, or ``"tag-<id>"`` of the one tag.
    site : mapping of int to PlanarPose
        All tags that lie there.
    route : tuple of int
        Those that are crossed, in their order.
    discs : Discs
    built : mapping of int to AsBuilt
        The discs by tag, against the design.
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
        """Flux density (..., 3) in tesla at ``points_m`` (..., 3)."""
        magnets, bits = disc_field(self.discs, points_m), debris_field(self.debris, points_m)
        return np.asarray(magnets + bits + self.earth_t)


def floor(tags: Tags, options: SimulationOptions) -> Floor:
    """Build the tags, and strew debris over those that are crossed.

    Raises
    ------
    InputError
        A tag of the route is not of the family, or not on the site; or several are to be
        crossed and there is no site.
    """
    site, route, frame = _world(tags, options.route)
    discs, built = _build(tags, site, options)
    earth = earth_field(options.earth_t, options.dip_rad, options.north_rad)
    debris = _strew(tags, [site[tag_id] for tag_id in dict.fromkeys(route)], discs, earth, options)
    return Floor(frame, site, route, discs, built, debris, earth)


def on_floor(at: PlanarPose, points: Array) -> Array:
    """Points (..., 2) of a tag's frame in the site's."""
    cos, sin = np.cos(at.heading_rad), np.sin(at.heading_rad)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + [at.x_m, at.y_m])


def _world(
    tags: Tags, route: tuple[int, ...]
) -> tuple[Mapping[int, PlanarPose], tuple[int, ...], str]:
    """Where the tags lie, which are crossed, and the frame's name."""
    if tags.site:
        strange = [tag_id for tag_id in route if tag_id not in tags.site]
        if strange:
            raise InputError(
                f"tag {strange[0]} is not on the site",
                hint="The site has " + ", ".join(map(str, tags.site)),
            )
        return tags.site, route or tuple(tags.site), "site"
    first = route[0] if route else (tags.ids or (0,))[0]
    if any(tag_id != first for tag_id in route):
        raise InputError(
            "several tags, and no site that says where they lie",
            hint="Give the tags a site, or cross one of them",
        )
    return {first: PlanarPose(0.0, 0.0, 0.0)}, (first,), f"tag-{first}"


def _build(
    tags: Tags, site: Mapping[int, PlanarPose], options: SimulationOptions
) -> tuple[Discs, dict[int, AsBuiltTag]]:
    """The magnets of all tags as they truly lie, and the same against the design."""
    ids: list[int] = []
    place: list[Array] = []
    angle: list[Array] = []
    strength: list[Array] = []
    built = {}
    for tag_id, at in site.items():
        if tags.ids is not None and tag_id not in tags.ids:
            raise InputError(
                f"tag {tag_id} is not of the family", hint=f"It has {len(tags.ids)} members"
            )
        layout = codec.layout_of(tags, tag_id)
        where, towards = as_built_magnets(tags, tag_id, layout)
        # By the tag's own number, so that it is the same on every site.
        rng = np.random.default_rng([options.build_seed, 20, tag_id])
        where = where + options.build_place_m * rng.normal(size=where.shape)
        towards = towards + options.build_angle_rad * rng.normal(size=towards.shape)
        strength.append(1 + options.build_strength * rng.normal(size=towards.shape))
        built[tag_id] = AsBuiltTag(
            where - cell_positions(tags, layout.cells),
            towards - symbol_angles(tags, layout.symbols),
        )
        ids += [tag_id] * len(where)
        place.append(on_floor(at, where))
        angle.append(np.angle(np.exp(1j * (towards + at.heading_rad))))
    discs = Discs(
        tags.magnet, tuple(ids), np.vstack(place), np.concatenate(angle), np.concatenate(strength)
    )
    return discs, built


def _strew(
    tags: Tags, at: list[PlanarPose], discs: Discs, earth: Array, options: SimulationOptions
) -> Debris:
    """Debris over each tag, and a spacing around it."""
    reach = ((tags.order - 1) / 2 + 1) * tags.spacing_m
    rng = np.random.default_rng([options.seed, 21])
    bits = [
        scatter(
            discs,
            np.array([tag.x_m, tag.y_m]) - reach,
            np.array([tag.x_m, tag.y_m]) + reach,
            options.debris,
            options.debris_size_m,
            options.debris_magnetised,
            earth,
            rng,
        )
        for tag in at
    ]
    return Debris(
        np.vstack([some.place_m for some in bits]), np.vstack([some.moment_am2 for some in bits])
    )
