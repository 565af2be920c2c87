"""Reading a sighting: which tag it is, and what it is not read as."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.polaris import codec
from locatk.core.polaris.array import Samples, SensorArray
from locatk.core.polaris.identification.evidence import conflicting_tags
from locatk.core.polaris.identification.tags import (
    IdentifiedPass,
    TagObservation,
    identify_tags,
    may_be_one_tag,
)
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.tag import AsBuiltTag, PlanarPose, TagLayout, Tags

Array = NDArray[np.float64]

TAGS = Tags()
CELLS = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2))
SYMBOLS = (0, 3, 5, 2, 6)
OTHER = (1, 7, 4, 4, 3)
REDUNDANT = Tags(codec="redundant", magnets=8)


def id_of(symbols: tuple[int, ...] = SYMBOLS, tags: Tags = TAGS) -> int:
    return codec.id_of(tags, TagLayout(CELLS, symbols))


def recording(width_m: float = 0.16) -> Samples:
    position = np.zeros((9, 3))
    position[:, 1] = np.linspace(-width_m / 2, width_m / 2, 9)
    time = np.arange(400, dtype=np.int64) * 10_000_000
    return Samples("bar", SensorArray(position), time, np.zeros((400, 9, 3)))


def detected_magnets(
    *tags: Any, keep: list[int] | None = None, first: int = 150, **more: Any
) -> DetectedMagnets:
    """The magnets of tags of the independent world, as a fit would give them."""
    point = np.vstack([tag.places for tag in tags])
    angle = np.concatenate([tag.angles for tag in tags])
    if keep is not None:
        point, angle = point[keep], angle[keep]
    m = len(point)
    sighting = DetectedMagnets(
        time_ns=2_000_000_000,
        first=first,
        stop=251,
        path_m=np.linspace(-0.1, 0.1, 251 - first),
        position_m=point,
        angle_rad=angle,
        moment_am2=np.full(m, 1.8e-3),
        covariance=np.diag(np.tile(np.square([2e-5, 2e-5, 2e-3]), m)),
        path_sigma_m=np.full(251 - first, 1e-5),
        height_m=0.01,
        height_sigma_m=1e-5,
        residual_sigma=1.0,
    )
    return replace(sighting, **more)


def one(result: tuple[TagObservation, ...]) -> TagObservation:
    (only,) = result
    return only


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.7])
def test_reads(heading: float, world: Any) -> None:
    tag = world.Tag(CELLS, SYMBOLS, x=0.02, y=-0.01, heading=heading)
    result = one(identify_tags(detected_magnets(tag), recording(), [TAGS]))
    assert (result.tag_id, result.refused) == (id_of(), "")
    said = result.detection("bar", recording().time_ns)
    assert said.tag_id == id_of()
    assert said.refused is None
    assert (said.x_m, said.y_m) == pytest.approx((0.02, -0.01), abs=1e-9)
    assert said.heading_rad == pytest.approx(heading)
    assert said.margin == pytest.approx(1.0)
    assert said.time_s == 2.0
    assert said.speed_mps == pytest.approx(0.2)
    pairs = {m.cell: m.symbol for m in said.magnets}
    assert pairs == dict(zip(CELLS, SYMBOLS, strict=True))


def test_array_in_the_tags_frame(world: Any) -> None:
    """The bar stands 5 cm behind the tag and 1 cm to its right, and looks as it does."""
    tag = world.Tag(CELLS, SYMBOLS, x=0.05, y=0.01, heading=0.0)
    pose = one(identify_tags(detected_magnets(tag), recording(), [TAGS])).array_pose
    assert pose is not None
    assert (pose.x_m, pose.y_m, pose.heading_rad) == pytest.approx((-0.05, -0.01, 0.0))
    # The same floor, looked at by a bar that is turned by a quarter to the left.
    tag = world.Tag(CELLS, SYMBOLS, x=0.01, y=-0.05, heading=-np.pi / 2)
    pose = one(identify_tags(detected_magnets(tag), recording(), [TAGS])).array_pose
    assert pose is not None
    assert (pose.x_m, pose.y_m, pose.heading_rad) == pytest.approx((-0.05, -0.01, np.pi / 2))


def test_no_tag_given(world: Any) -> None:
    result = one(identify_tags(detected_magnets(world.Tag(CELLS, SYMBOLS)), recording(), []))
    assert result.refused == "no_tag_given"
    assert result.detection("bar", recording().time_ns).x_m is None


@pytest.mark.parametrize(
    ("y", "keep", "reason"),
    [
        (0.0, [0, 1, 2, 3], "magnets_missing"),
        (0.0, [1, 2, 3, 4], "magnets_missing"),
        (0.0, [0, 4], "magnets_missing"),
        (0.1, [1, 3, 4], "partial"),  # beyond the bar's left end
        (-0.1, [0, 1, 2], "partial"),
    ],
)
def test_magnets_missing_or_beyond_the_bar(
    y: float, keep: list[int], reason: str, world: Any
) -> None:
    result = one(
        identify_tags(
            detected_magnets(world.Tag(CELLS, SYMBOLS, y=y), keep=keep), recording(), [TAGS]
        )
    )
    assert (result.tag_id, result.refused) == (None, reason)


def test_a_pass_that_reaches_the_recordings_end_is_partial(world: Any) -> None:
    tag = world.Tag(CELLS, SYMBOLS)
    result = one(identify_tags(detected_magnets(tag, keep=[0, 1, 2], first=0), recording(), [TAGS]))
    assert result.refused == "partial"


def test_two_readings_of_the_same_magnets_are_ambiguous(world: Any) -> None:
    """Four magnets on all corners: which three are the position pattern's, none can say."""
    square = world.Tag(((0, 0), (0, 2), (2, 2), (2, 0)), (1, 3, 5, 7))
    result = one(identify_tags(detected_magnets(square), recording(), [replace(TAGS, magnets=4)]))
    assert result.tag_id is None
    extra = world.Tag((*CELLS, (2, 0)), (*SYMBOLS, 1))
    assert all(
        item.tag_id is None for item in identify_tags(detected_magnets(extra), recording(), [TAGS])
    )


def test_not_in_the_family(world: Any) -> None:
    family = replace(TAGS, ids=(0, 100_000, id_of(OTHER)), min_distance=3)
    result = one(identify_tags(detected_magnets(world.Tag(CELLS, SYMBOLS)), recording(), [family]))
    assert (result.tag_id, result.refused) == (None, "not_in_family")
    assert one(
        identify_tags(detected_magnets(world.Tag(CELLS, OTHER)), recording(), [family])
    ).tag_id == id_of(OTHER)


def test_orientation_between_two_is_a_tie(world: Any) -> None:
    turned = np.array([0, 0, np.radians(22.5), 0, 0])
    tag = world.Tag(CELLS, SYMBOLS, turned=turned)
    result = one(identify_tags(detected_magnets(tag), recording(), [TAGS]))
    assert (result.tag_id, result.refused) == (None, "tie")


def test_bad_residual_is_refused(world: Any) -> None:
    bad = detected_magnets(
        world.Tag(CELLS, SYMBOLS), residual_sigma=50.0, robust_residual_sigma=50.0
    )
    result = one(identify_tags(bad, recording(), [TAGS]))
    assert (result.tag_id, result.refused) == (None, "residual")


@pytest.mark.parametrize(("rms", "usual"), [(5.0, 1.0), (3.0, 2.5)])
def test_either_residual_refuses(rms: float, usual: float, world: Any) -> None:
    bad = detected_magnets(
        world.Tag(CELLS, SYMBOLS), residual_sigma=rms, robust_residual_sigma=usual
    )
    assert one(identify_tags(bad, recording(), [TAGS])).refused == "residual"


@pytest.mark.parametrize(("rms", "refused"), [(1.2, ""), (2.2, "residual")])
def test_a_doubtful_residual_needs_a_margin(rms: float, refused: str, world: Any) -> None:
    """A magnet 17 degrees off its orientation: a margin of a quarter step."""
    tag = world.Tag(CELLS, SYMBOLS, turned=np.radians([0, 0, 17.0, 0, 0]))
    result = one(
        identify_tags(
            detected_magnets(tag, residual_sigma=rms, robust_residual_sigma=1.0),
            recording(),
            [TAGS],
        )
    )
    assert result.decoded is not None
    assert 0.2 < result.decoded.margin < 0.3
    assert result.refused == refused
    assert result.tag_id == (None if refused else id_of())


def test_magnets_off_their_cells_are_refused(world: Any) -> None:
    """A fifth of a spacing: no hand is so bad, it is another grid."""
    rng = np.random.default_rng(1)
    tag = world.Tag(CELLS, SYMBOLS, moved=rng.choice([-6e-3, 6e-3], (5, 2)))
    assert all(
        item.tag_id is None for item in identify_tags(detected_magnets(tag), recording(), [TAGS])
    )


def test_a_path_of_another_scale_is_refused(world: Any) -> None:
    """The tag is the ruler of a way unknown, but for a tenth at most: beyond, it is not
    the tag."""
    sighting = detected_magnets(world.Tag(CELLS, SYMBOLS), is_path_estimated=True)
    for scale, reason in ((0.96, ""), (0.87, "misfit"), (1.14, "misfit")):
        stretched = replace(sighting, position_m=sighting.position_m * [scale, 1.0])
        assert one(identify_tags(stretched, recording(), [TAGS])).refused == reason


@pytest.mark.parametrize("gone", range(8))
def test_redundant_tag_survives_a_missing_magnet(gone: int, world: Any) -> None:
    layout = codec.layout_of(REDUNDANT, 1234)
    tag = world.Tag(layout.cells, layout.symbols, heading=1.0)
    keep = [k for k in range(8) if k != gone]
    result = one(identify_tags(detected_magnets(tag, keep=keep), recording(), [REDUNDANT]))
    assert result.tag_id == 1234
    assert result.decoded is not None
    assert result.decoded.erased == 1


def test_redundant_tag_survives_a_misread_orientation_too(world: Any) -> None:
    layout = codec.layout_of(REDUNDANT, 777)
    turned = np.zeros(8)
    turned[3] = np.radians(100)
    tag = world.Tag(layout.cells, layout.symbols, turned=turned)
    for keep in (list(range(8)), [0, 1, 3, 4, 5, 6, 7]):
        result = one(identify_tags(detected_magnets(tag, keep=keep), recording(), [REDUNDANT]))
        assert result.tag_id == 777
        assert result.decoded is not None
        assert result.decoded.corrected >= 1


def test_redundant_tag_beyond_its_code_is_refused(world: Any) -> None:
    """Facts 6: Reed-Solomon alone decodes such words to others, silently."""
    rng = np.random.default_rng(4)
    wrong = 0
    for tag_id in rng.integers(codec.capacity(REDUNDANT), size=25).tolist():
        layout = codec.layout_of(REDUNDANT, tag_id)
        turned = np.zeros(8)
        turned[rng.choice(8, 3, replace=False)] = np.radians(45) * rng.integers(1, 8, 3)
        result = one(
            identify_tags(
                detected_magnets(world.Tag(layout.cells, layout.symbols, turned=turned)),
                recording(),
                [REDUNDANT],
            )
        )
        assert result.refused or result.tag_id is not None
        wrong += result.tag_id not in (None, tag_id)
    assert wrong == 0


def test_as_built_angles_and_places_are_used(world: Any) -> None:
    """A tag whose magnets are off by up to 20 degrees and 1.5 mm, as calibrated."""
    turned = np.radians([20.0, -18.0, 15.0, -20.0, 12.0])
    moved = 1e-3 * np.array([[1.5, 0], [0, -1], [-1, 0.5], [0.5, 1], [-1, -0.5]])
    tag = world.Tag(CELLS, SYMBOLS, x=0.01, heading=0.7, turned=turned, moved=moved)
    built = replace(TAGS, built={id_of(): AsBuiltTag(moved, turned, 5)})
    plain = one(identify_tags(detected_magnets(tag), recording(), [TAGS]))
    known = one(identify_tags(detected_magnets(tag), recording(), [built]))
    assert known.tag_id == id_of()
    assert known.decoded is not None
    assert plain.decoded is not None
    assert known.decoded.margin > 0.9 > plain.decoded.margin
    assert known.match is not None
    assert (known.match.x_m, known.match.y_m) == pytest.approx((0.01, 0.0), abs=1e-6)
    assert known.match.heading_rad == pytest.approx(0.7, abs=1e-5)


def test_two_tags_side_by_side(world: Any) -> None:
    """As near as they can lie: none borrows a magnet of the other."""
    tags = [
        world.Tag(CELLS, SYMBOLS, y=-0.065, heading=0.2),
        world.Tag(CELLS, OTHER, y=0.065, heading=-1.0),
    ]
    result = identify_tags(detected_magnets(*tags, is_path_estimated=True), recording(0.28), [TAGS])
    assert {item.tag_id for item in result} == {id_of(SYMBOLS), id_of(OTHER)}
    for item in result:
        tag = tags[0] if item.tag_id == id_of(SYMBOLS) else tags[1]
        assert item.match is not None
        assert item.match.y_m == pytest.approx(tag.y, abs=1e-6)


LARGE = Tags(order=4, magnets=8)
LARGE_CELLS = ((0, 0), (2, 1), (0, 2), (1, 2), (2, 2), (0, 3), (3, 3), (3, 1))
"""A tag of 4 x 4 whose first three columns and rows 0 to 2 hold a tag of 3 x 3: all but its
corner (2, 2) are also in one of ``SMALL_CELLS``."""
LARGE_SYMBOLS = (0, 3, 5, 2, 6, 1, 4, 7)


def large_tag(world: Any, **more: Any) -> Any:
    return world.Tag(LARGE_CELLS, LARGE_SYMBOLS, order=4, **more)


def large_id() -> int:
    order = sorted(range(8), key=lambda k: LARGE_CELLS[k][::-1])
    cells, symbols = (tuple(each[k] for k in order) for each in (LARGE_CELLS, LARGE_SYMBOLS))
    return codec.id_of(LARGE, TagLayout(cells, symbols))


@pytest.mark.parametrize("heading", [0.0, 0.4, 2.0])
def test_a_part_of_a_larger_tag_is_no_tag(heading: float, world: Any) -> None:
    """Five magnets of it are a perfect tag of 3 x 3, and three continue its grid."""
    magnets = detected_magnets(large_tag(world, heading=heading), is_path_estimated=True)
    part = detected_magnets(large_tag(world, heading=heading), keep=[0, 1, 2, 3, 4])
    assert one(identify_tags(part, recording(0.28), [TAGS])).tag_id is not None
    result = one(identify_tags(magnets, recording(0.28), [TAGS]))
    assert (result.tag_id, result.refused) == (None, "other_design")
    detection = result.detection("bar", np.arange(400, dtype=np.int64))
    assert len(detection.magnets) == 8


@pytest.mark.parametrize(
    ("moment", "is_read"), [(1.0, False), (0.7, False), (1.6, False), (0.4, True), (2.5, True)]
)
def test_a_source_on_the_grid_counts_if_it_is_as_strong_as_the_magnets(
    moment: float, is_read: bool, world: Any
) -> None:
    screw = world.Tag(((0, 0),), (0,), x=-0.08, y=0.0, order=1)
    magnets = detected_magnets(world.Tag(CELLS, SYMBOLS), screw)
    strength = np.r_[np.full(5, 1.8e-3), moment * 1.8e-3]
    result = one(identify_tags(replace(magnets, moment_am2=strength), recording(), [TAGS]))
    assert (result.tag_id is not None) is is_read


@pytest.mark.parametrize(
    ("x", "y", "is_read"),
    [
        (-0.065, 0.01, True),  # Beside the tag, not on its grid.
        (0.02, 0.012, True),  # A single one in it.
        (0.02, 0.02, False),  # On the grid of half the spacing.
        (-0.04, 0.04, False),  # Corner v4, which no tag occupies.
        (-0.32, 0.0, True),  # On the grid, but far away.
    ],
)
def test_a_magnet_beside_a_tag_is_reported(x: float, y: float, is_read: bool, world: Any) -> None:
    stray = world.Tag(((0, 0),), (2,), x=x, y=y, order=1)
    cells, symbols = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2)), SYMBOLS
    magnets = detected_magnets(world.Tag(cells, symbols), stray)
    result = one(identify_tags(magnets, recording(), [TAGS]))
    assert (result.tag_id is not None) is is_read
    if is_read:
        (other,) = result.detection("bar", np.arange(400, dtype=np.int64)).other_magnets
        assert (other.x_m, other.y_m) == pytest.approx((x, y))
        assert other.moment_am2 == pytest.approx(1.8e-3)
    else:
        assert result.refused in ("other_design", "too_many_magnets")


EDGE_TO_EDGE_M = 0.12
"""Distance of two tags whose lattices continue each other."""


@pytest.mark.parametrize(
    ("ids", "site", "is_read"),
    [
        (None, (), False),
        (range(20), (), True),
        # A family that one orientation in a hundred belongs to by coincidence.
        (range(0, 327_680, 100), (), False),
        (None, (SYMBOLS, OTHER), True),
        (None, (OTHER,), False),
    ],
)
def test_a_neighbour_edge_to_edge(ids: Any, site: Any, is_read: bool, world: Any) -> None:
    """Two of its magnets, at the end of the bar, continue the lattice."""
    tag = world.Tag(CELLS, SYMBOLS)
    neighbour = world.Tag(CELLS, OTHER, y=EDGE_TO_EDGE_M)
    at_the_bar = np.flatnonzero(neighbour.places[:, 1] < 0.09)
    magnets = detected_magnets(tag, neighbour, keep=[*range(5), *(5 + at_the_bar)])
    family = None if ids is None else (id_of(), *(k for k in ids if k != id_of()))
    poses = {id_of(symbols): PlanarPose(0.0, 0.0, 0.0) for symbols in site}
    tags = replace(TAGS, ids=family, site=poses)
    result = one(identify_tags(magnets, recording(), [tags]))
    assert result.tag_id == (id_of() if is_read else None)
    assert result.refused == ("" if is_read else "other_design")


@pytest.mark.parametrize("is_on_site", [True, False])
def test_five_magnets_of_two_tags_that_fit_the_grid(is_on_site: bool, world: Any) -> None:
    """The column of a neighbour that the bar covers forms another tag with two of the tag."""
    cells = ((0, 0), (1, 0), (0, 2), (1, 2), (2, 2))
    tag_id = codec.id_of(TAGS, TagLayout(cells, SYMBOLS))
    neighbour_cells = ((1, 0), (0, 1), (2, 2), (0, 0), (0, 2))
    neighbour = world.Tag(neighbour_cells, OTHER, y=EDGE_TO_EDGE_M)
    at_the_bar = np.flatnonzero(neighbour.places[:, 1] < 0.09)
    keep = [*range(5), *(5 + at_the_bar)]
    magnets = detected_magnets(world.Tag(cells, SYMBOLS), neighbour, keep=keep)
    site = {tag_id: PlanarPose(0.0, 0.0, 0.0)} if is_on_site else {}
    result = identify_tags(magnets, recording(), [replace(TAGS, site=site)])
    assert [each.tag_id for each in result] == [tag_id if is_on_site else None]


def test_magnets_within_the_grid_outweigh_the_id(world: Any) -> None:
    magnets = detected_magnets(world.Tag(CELLS, SYMBOLS), world.Tag(((2, 0),), (2,)))
    tags = replace(TAGS, site={id_of(): PlanarPose(0.0, 0.0, 0.0)})
    assert one(identify_tags(magnets, recording(), [tags])).tag_id is None


def test_several_strong_magnets_within_the_grid(world: Any) -> None:
    strays = [world.Tag(((0, 0),), (2,), x=0.012, y=y, order=1) for y in (0.03, -0.03)]
    magnets = detected_magnets(world.Tag(CELLS, SYMBOLS), *strays)
    assert one(identify_tags(magnets, recording(), [TAGS])).refused == "other_design"


@pytest.mark.parametrize("designs", [[TAGS, LARGE], [LARGE, TAGS]])
def test_the_design_that_explains_all_magnets_is_chosen(designs: list[Tags], world: Any) -> None:
    for tag, tags, tag_id in (
        (large_tag(world), LARGE, large_id()),
        (world.Tag(CELLS, SYMBOLS), TAGS, id_of()),
    ):
        result = one(identify_tags(detected_magnets(tag), recording(), designs))
        assert (result.tag_id, result.tags is tags) == (tag_id, True)


def test_tags_of_two_designs_in_a_pass_are_in_order_of_time(world: Any) -> None:
    """The larger one is matched first, and passed last."""
    placed = [world.Tag(CELLS, SYMBOLS, x=-0.12, heading=0.3), large_tag(world, x=0.12)]
    magnets = detected_magnets(*placed)
    expected = [(id_of(), TAGS), (large_id(), LARGE)]
    result = identify_tags(magnets, recording(), [TAGS, LARGE])
    assert [(each.tag_id, each.tags) for each in result] == expected
    backward = replace(magnets, path_m=-magnets.path_m)
    result = identify_tags(backward, recording(), [TAGS, LARGE])
    assert [(each.tag_id, each.tags) for each in result] == expected[::-1]


def test_two_designs_that_fit_are_ambiguous(world: Any) -> None:
    """Every tag of 8 orientations is one of 16, too; families tell them apart."""
    fine = replace(TAGS, orientations=16)
    magnets = detected_magnets(world.Tag(CELLS, SYMBOLS))
    result = one(identify_tags(magnets, recording(), [TAGS, fine]))
    assert (result.tag_id, result.refused) == (None, "ambiguous")
    family = replace(TAGS, ids=(id_of(OTHER),))
    result = one(identify_tags(magnets, recording(), [family, fine]))
    assert (result.tags, result.refused) == (fine, "")


@pytest.mark.parametrize(
    ("spacing", "moment", "height", "refused"),
    [
        (0.040, 1.0, 1.0, ""),
        (0.0404, 0.55, 1.18, ""),  # The published recordings.
        (0.037, 1.0, 1.0, "other_design"),
        (0.043, 1.0, 1.0, "other_design"),
        (0.040, 4.5, 1.0, "other_design"),
        (0.040, 0.25, 1.0, "other_design"),
        (0.040, 1.0, 2.2, "other_design"),
        (0.040, 1.0, 0.4, "other_design"),
    ],
)
def test_spacing_moment_and_height_are_those_of_the_design(
    spacing: float, moment: float, height: float, refused: str, world: Any
) -> None:
    tag = world.Tag(CELLS, SYMBOLS, spacing=spacing, heading=0.5)
    magnets = detected_magnets(
        tag,
        is_path_estimated=True,
        moment_am2=np.full(5, moment * TAGS.magnet.moment),
        height_m=height * TAGS.clearance_m,
    )
    assert one(identify_tags(magnets, recording(), [TAGS])).refused == refused


def test_an_unreadable_tag_beside_a_read_one_is_reported(world: Any) -> None:
    """On the same lattice, as if both were parts of one tag: both are complete."""
    family = replace(TAGS, ids=(id_of(),))
    placed = [world.Tag(CELLS, SYMBOLS, x=-0.06), world.Tag(CELLS, OTHER, x=0.06)]
    result = identify_tags(detected_magnets(*placed), recording(), [family])
    assert [(each.tag_id, each.refused) for each in result] == [
        (id_of(), ""),
        (None, "not_in_family"),
    ]


def test_a_tag_and_what_is_left_of_another(world: Any) -> None:
    tags = [
        world.Tag(CELLS, SYMBOLS, x=-0.1, heading=0.2),
        world.Tag(CELLS, OTHER, x=0.1, heading=-1.0),
    ]
    result = identify_tags(
        detected_magnets(*tags, keep=[0, 1, 2, 3, 4, 5, 6, 7]), recording(), [TAGS]
    )
    assert [item.tag_id for item in result if item.tag_id is not None] == [id_of(SYMBOLS)]


@pytest.mark.parametrize(("gap", "expected"), [(20, True), (400, False)])
def test_ends_of_one_tag_are_near_each_other(gap: int, expected: bool, world: Any) -> None:
    """Steps of 2 mm; a tag of three cells of 40 mm is at most 180 mm away."""
    part = detected_magnets(world.Tag(CELLS, SYMBOLS), keep=[0, 1])
    before = IdentifiedPass(part, identify_tags(part, recording(), [TAGS]))
    later = replace(part, first=part.stop + gap, stop=part.stop + gap + 101)
    after = IdentifiedPass(later, before.observations)
    assert may_be_one_tag(before, after, TAGS) is expected
    whole = detected_magnets(world.Tag(CELLS, SYMBOLS))
    identified = IdentifiedPass(whole, identify_tags(whole, recording(), [TAGS]))
    assert not may_be_one_tag(identified, after, TAGS)


def test_the_same_tag_twice_in_a_pass_is_ambiguous(world: Any) -> None:
    tags = [world.Tag(CELLS, SYMBOLS, x=x) for x in (-0.1, 0.1)]
    observations = identify_tags(detected_magnets(*tags), recording(), [TAGS])
    assert [each.refused for each in observations] == ["ambiguous", "ambiguous"]
    assert all(each.tag_id is None for each in observations)


def test_a_white_residual_needs_no_margin(world: Any) -> None:
    tag = world.Tag(CELLS, SYMBOLS, turned=np.radians([0, 0, 17.0, 0, 0]))
    result = one(identify_tags(detected_magnets(tag, residual_sigma=1.59), recording(), [TAGS]))
    assert result.tag_id == id_of()


MINI = Tags(order=2, magnets=3)


@pytest.mark.parametrize(
    ("tags", "x_m", "y_m", "heading", "is_conflict"),
    [
        (TAGS, 0.0, 0.12, 0.0, False),  # Two ids of many: read.
        (TAGS, 0.0, 0.06, 0.0, True),  # Overlapping.
        (TAGS, 0.08, 0.08, np.pi / 4, True),
        (MINI, 0.0, 0.08, 0.0, True),
        (MINI, 0.12, 0.04, np.pi / 2, True),
        (MINI, 0.0, 0.09, 0.0, False),
        (MINI, 0.0, 0.13, 0.6, False),
        (MINI, 0.0, 0.40, 0.0, False),
    ],
)
def test_tags_on_a_site_that_make_each_other_unreadable(
    tags: Tags, x_m: float, y_m: float, heading: float, is_conflict: bool
) -> None:
    at = PlanarPose(0.3, -1.2, 0.7)
    cos, sin = np.cos(at.heading_rad), np.sin(at.heading_rad)
    x, y = at.x_m + cos * x_m - sin * y_m, at.y_m + sin * x_m + cos * y_m
    site = {5: at, 77: PlanarPose(x, y, at.heading_rad + heading)}
    assert conflicting_tags(replace(tags, site=site)) == ([(5, 77)] if is_conflict else [])
