"""Reading a sighting: which tag it is, and what it is not read as."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.polaris import codec
from locatk.core.polaris.array import Samples, SensorArray
from locatk.core.polaris.identification.tags import (
    IdentifiedPass,
    TagObservation,
    identify_tags,
    may_be_one_tag,
)
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.tag import AsBuiltTag, TagLayout, Tags

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
