"""A sighting, read: which tag, how surely, and where it lies."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris import codec
from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.magnets import WHITE
from locatk.core.polaris.identification.decoding import Reading, read
from locatk.core.polaris.identification.matching import FAIR, Match, matches, refitted, ruled
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.results import MagnetDetection, PlanarPose, TagDetection
from locatk.core.polaris.tag import Tags, built_magnets, places

Array = NDArray[np.float64]

SCALE_OFF = 0.1
"""Largest deviation of the way's scale from 1."""

USUAL_RESIDUAL, RESIDUAL = 2.0, 4.0
"""Largest residual of a tag that is read, in standard deviations of the noise: by the median,
and its rms (debris leaves peaks; a way that was another one, too)."""


DOUBT = 0.2
"""Margin in steps that a residual above WHITE must leave, for each standard deviation: a
magnet that the fit has put wrongly bends the directions of its neighbours."""


@dataclass(frozen=True)
class Seen:
    """A tag, or what may be one, in a sighting.

    Attributes
    ----------
    sighting : Sighting
        With lengths along the track measured by the tag, where that was read.
    match : Match or None
    reading : Reading or None
    refused : str
        "" or why there is no id.
    """

    sighting: DetectedMagnets
    match: Match | None
    reading: Reading | None
    refused: str = ""

    @property
    def tag_id(self) -> int | None:
        """The id, None where it was not read."""
        return None if self.reading is None or self.refused else self.reading.tag_id

    @property
    def array_pose(self) -> tuple[float, float, float]:
        """The array in the tag's frame: x, y in m and heading in rad."""
        assert self.match is not None
        cos, sin = np.cos(self.match.heading_rad), np.sin(self.match.heading_rad)
        x, y = self.match.x_m, self.match.y_m
        return -(cos * x + sin * y), sin * x - cos * y, -self.match.heading_rad

    def detection(self, device: str, time_ns: NDArray[np.int64]) -> TagDetection:
        """Return the detection that reports it; ``time_ns`` (n,) are those of the samples."""
        sighting, match, reading = self.sighting, self.match, self.reading
        first, last = sighting.first, min(sighting.stop, len(time_ns)) - 1
        seconds = (time_ns[last] - time_ns[first]) * 1e-9
        sigma = np.full(3, np.nan) if match is None else np.sqrt(np.diag(match.covariance))
        return TagDetection(
            time_s=sighting.time_ns * 1e-9,
            device=device,
            tag_id=self.tag_id,
            margin=None if reading is None else reading.margin,
            refused=self.refused or None,
            x_m=None if match is None else match.x_m,
            y_m=None if match is None else match.y_m,
            heading_rad=None if match is None else match.heading_rad,
            sigma_x_m=sigma[0],
            sigma_y_m=sigma[1],
            sigma_heading_rad=sigma[2],
            array_pose=None if match is None else PlanarPose(*self.array_pose),
            magnets=self._magnets(),
            residual_sigma=sighting.residual_sigma,
            height_m=sighting.height_m,
            speed_mps=float(np.ptp(sighting.path_m) / seconds) if seconds > 0 else None,
            scale=1.0 if match is None else match.scale,
            corrected=None if reading is None else reading.corrected,
            erased=None if reading is None else reading.erased,
            other_sources=sighting.others,
        )

    def _magnets(self) -> tuple[MagnetDetection, ...]:
        sighting = self.sighting
        cells = {}
        if self.match is not None and self.reading is not None:
            symbols = self.reading.symbols
            cells = dict(
                zip(self.match.magnets, zip(self.match.cells, symbols, strict=True), strict=True)
            )
        order = list(cells) if self.tag_id is not None else range(len(sighting))
        sigma = np.sqrt(np.diag(sighting.covariance)).reshape(-1, 3)
        return tuple(
            MagnetDetection(
                x_m=sighting.place_m[k, 0],
                y_m=sighting.place_m[k, 1],
                angle_rad=sighting.angle_rad[k],
                symbol=cells[k][1] if k in cells else None,
                cell=cells[k][0] if k in cells else None,
                sigma_x_m=sigma[k, 0],
                sigma_y_m=sigma[k, 1],
                sigma_angle_rad=sigma[k, 2],
                moment_am2=sighting.moment_am2[k],
            )
            for k in order
        )


def identify(sighting: DetectedMagnets, recording: Samples, tags: Tags | None) -> list[Seen]:
    """The tags in a sighting, as they were read one after the other; at least one entry, which
    is refused where nothing could be read."""
    if tags is None:
        return [Seen(sighting, None, None, "no_tag_given")]
    found: list[Seen] = []
    used: frozenset[int] = frozenset()
    while True:
        seen = _best(sighting, recording, tags, used)
        if seen.tag_id is None:
            break
        assert seen.match is not None
        found.append(seen)
        used |= frozenset(seen.match.magnets)
        if len(sighting) - len(used) < 3:
            break
    if len({item.tag_id for item in found}) < len(found):
        # A tag lies in one place: the way was another one than it seems.
        return [replace(item, refused="ambiguous") for item in found]
    return found or [seen]


def _best(sighting: DetectedMagnets, recording: Samples, tags: Tags, used: frozenset[int]) -> Seen:
    candidates = matches(sighting, tags, used)
    if not candidates:
        return Seen(sighting, None, None, _incomplete(sighting, recording, tags, None))
    readings = [(match, _read(sighting, tags, match)) for match in candidates]
    read_as = [(match, reading) for match, reading in readings if reading.tag_id is not None]
    if not read_as:
        match, reading = readings[0]
        reason = reading.refused
        if reason in ("magnets_missing", "vertex_missing") and len(match.cells) < tags.magnets:
            reason = _incomplete(sighting, recording, tags, match)
        return Seen(sighting, match, reading, reason)
    match, reading = read_as[0]
    shared = set(match.magnets)
    rivals = {other.tag_id for rival, other in read_as if shared & set(rival.magnets)}
    if len(rivals) > 1:
        return Seen(sighting, match, reading, "ambiguous")
    assert reading.tag_id is not None
    layout = codec.layout_of(tags, reading.tag_id)
    if reading.tag_id in tags.built:
        place, _ = built_magnets(tags, reading.tag_id, layout)
        at = [layout.cells.index(cell) for cell in match.cells]
        match = refitted(sighting, tags, match, place[at])
    refused = ""
    if match.misfit_m > FAIR * tags.spacing_m or abs(match.scale - 1) > SCALE_OFF:
        refused = "misfit"
    elif (
        sighting.usual_sigma > USUAL_RESIDUAL
        or sighting.residual_sigma > RESIDUAL
        or (sighting.residual_sigma > WHITE and reading.margin < DOUBT * sighting.residual_sigma)
    ):
        refused = "residual"
    return Seen(ruled(sighting, match), match, reading, refused)


def _read(sighting: DetectedMagnets, tags: Tags, match: Match) -> Reading:
    chosen = list(match.magnets)
    angle = sighting.angle_rad[chosen] - match.heading_rad
    sigma = np.sqrt(np.diag(sighting.covariance))[2::3][chosen] / tags.step_rad
    return read(tags, match.cells, -angle / tags.step_rad, sigma)


def _incomplete(
    sighting: DetectedMagnets, recording: Samples, tags: Tags, match: Match | None
) -> str:
    """Why magnets are missing: the tag reaches beyond the bar or the recording, or not."""
    across = recording.array.position_m[:, 1]
    reach = np.max(np.abs(across)) + 0.5 * tags.clearance_m
    if match is not None and len(match.cells) > 2:
        grid = tuple((c, r) for r in range(tags.order) for c in range(tags.order))
        place = places(tags, grid)
        sin, cos = np.sin(match.heading_rad), np.cos(match.heading_rad)
        beside = sin * place[:, 0] + cos * place[:, 1] + match.y_m
        if np.any(np.abs(beside) > reach):
            return "partial"
    elif np.any(np.abs(sighting.place_m[:, 1]) > reach - tags.spacing_m):
        return "partial"
    if np.any(np.abs(sighting.place_m[:, 1]) > reach - 0.25 * tags.spacing_m):
        return "partial"  # a tag goes on where a magnet lies at the very end
    ends = sighting.first <= 1 or sighting.stop >= len(recording) - 1
    return "partial" if ends else "magnets_missing"
