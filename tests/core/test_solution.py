"""JSON form of typed results: what :func:`to_json` writes, :func:`from_json` reads back."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, fields, is_dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.dots.results import DotDetection, DotFacts
from locatk.core.landmarks.results import LandmarkDetection, LandmarkFacts, RobotFacts
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.polaris.results import HeadingCorrection, PolarisFacts, TagDetection
from locatk.core.solution import GenericRecord, SolverWarning, from_json, to_json

RECORDS = (
    StationDetection,
    LighthouseFacts,
    DotDetection,
    DotFacts,
    TagDetection,
    PolarisFacts,
    LandmarkDetection,
    LandmarkFacts,
    SolverWarning,
)

finite = st.floats(allow_nan=False, allow_infinity=False)
st.register_type_strategy(float, finite)


@pytest.mark.slow
@pytest.mark.parametrize("kind", RECORDS, ids=lambda kind: kind.__name__)
@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_every_record_comes_back_from_its_json_form(kind: type, data: st.DataObject) -> None:
    record = data.draw(st.from_type(kind))
    assert from_json(kind, json.loads(json.dumps(to_json(record)))) == record


@pytest.mark.parametrize("kind", RECORDS, ids=lambda kind: kind.__name__)
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_unknown_keys_are_ignored_and_missing_ones_are_named(
    kind: type, data: st.DataObject
) -> None:
    record = data.draw(st.from_type(kind))
    table = to_json(record)
    assert from_json(kind, {**table, "of_a_later_version": 1}) == record
    for item in fields(kind):
        key = item.metadata.get("json", item.name)
        if key in table and item.default is not None and not callable(item.default_factory):
            if item.default == ():
                continue  # a list that is missing is empty
            with pytest.raises(KeyError, match=key):
                from_json(kind, {k: v for k, v in table.items() if k != key})


def test_stable_keys_differ_from_clearer_names() -> None:
    correction = HeadingCorrection("bar", 1.0, 3, 7, 0.5, 0.01, 2.0)
    assert to_json(correction) == {
        "device": "bar", "time_s": 1.0, "from": 3, "to": 7,
        "turn_rad": 0.5, "sigma_turn_rad": 0.01, "distance_m": 2.0,
    }  # fmt: skip


def test_none_is_left_out_only_of_fields_that_are_none_by_default() -> None:
    robot = RobotFacts(localised=False, landmarks_seen=2)
    table = {
        "localised": False,
        "provisional": False,
        "landmarks_seen": 2,
        "landmarks_to_localise": None,
    }
    assert to_json(robot) == table
    assert from_json(RobotFacts, table) == robot
    # Files of earlier versions, of the published method.
    assert from_json(RobotFacts, {"localised": False, "landmarks_seen": 2}) == robot


@dataclass(frozen=True)
class _Unknowns:
    number: float
    optional: float | None
    several: tuple[float, ...]


def test_an_unknown_number_is_nan_or_none_as_its_field_declares() -> None:
    found = from_json(_Unknowns, {"number": None, "optional": None, "several": [1, None]})
    assert math.isnan(found.number)
    assert found.optional is None
    assert found.several[0] == 1
    assert math.isnan(found.several[1])


@pytest.mark.parametrize(
    ("kind", "odd"),
    [
        (SolverWarning, {"code": 3, "message": "m"}),
        (SolverWarning, {"code": None, "message": "m"}),
        (SolverWarning, ["code", "message"]),
        (DotFacts, {"frames": {}}),
        (DotFacts, {"frames": [3]}),
        (LandmarkFacts, {"robots": []}),
        (RobotFacts, {"localised": 1, "landmarks_seen": 2, "landmarks_to_localise": None}),
        (RobotFacts, {"localised": True, "landmarks_seen": True, "landmarks_to_localise": None}),
        (RobotFacts, {"localised": True, "landmarks_seen": 2.5, "landmarks_to_localise": None}),
        (_Unknowns, {"number": "1", "optional": None, "several": []}),
    ],
)
def test_values_of_other_types_are_refused(kind: type, odd: object) -> None:
    with pytest.raises(TypeError):
        from_json(kind, odd)  # type: ignore[arg-type]


def test_pairs_have_two_values() -> None:
    table = {"first": [1, 2]}

    @dataclass(frozen=True)
    class Pair:
        first: tuple[int, int]

    assert from_json(Pair, table).first == (1, 2)
    with pytest.raises(TypeError, match="3 values"):
        from_json(Pair, {"first": [1, 2, 3]})


def test_arrays_and_numpy_numbers_become_plain() -> None:
    @dataclass(frozen=True)
    class Numbers:
        rows: np.ndarray
        count: int
        values: dict[str, float] = field(default_factory=dict)

    record = Numbers(np.eye(2), np.int64(3), {"1": np.float64(0.5)})  # type: ignore[arg-type]
    assert is_dataclass(record)
    text = json.dumps(to_json(record))
    assert json.loads(text) == {"rows": [[1, 0], [0, 1]], "count": 3, "values": {"1": 0.5}}


def test_records_of_unknown_systems_keep_all_they_have() -> None:
    table = {"depth_m": 3.0, "echoes": [{"t": 1}]}
    assert from_json(GenericRecord, table) == GenericRecord(table)
    assert to_json(GenericRecord(table)) == table


def test_a_warning_names_its_subject() -> None:
    assert SolverWarning("spikes", "7 values").about("bar") == SolverWarning(
        "spikes", "bar: 7 values"
    )
