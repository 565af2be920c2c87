"""Messages of VDA 5050: fields that its schemas require, topics, life of the connection."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from locatk.core.streaming.events import TrackingState
from locatk.formats.sinks.confidence import deviation_radius_m, localization_score
from locatk.formats.sinks.vda5050 import Interface, sanitise, timestamp


def strict(required: dict[str, Any], optional: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the schema of an object with these properties and no others."""
    return {
        "type": "object",
        "required": list(required),
        "properties": required | (optional or {}),
        "additionalProperties": False,
    }


TEXT = {"type": "string"}
NUMBER = {"type": "number"}
FLAG = {"type": "boolean"}
COUNTER = {"type": "integer", "minimum": 0, "maximum": 2**32 - 1}
NONE = {"type": "array", "maxItems": 0}
ANGLE = {"type": "number", "minimum": -math.pi, "maximum": math.pi}
SCORE = {"localizationScore": {"type": "number", "minimum": 0, "maximum": 1}}
DEVIATION = {"deviationRange": {"type": "number", "minimum": 0}}


def header(major: str, digits: int) -> dict[str, Any]:
    pattern = rf"^\d{{4}}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{{{digits}}}Z$"
    return {
        "headerId": COUNTER,
        "timestamp": {"type": "string", "pattern": pattern},
        "version": {"type": "string", "pattern": rf"^{major}\.\d+\.\d+$"},
        "manufacturer": TEXT,
        "serialNumber": {"type": "string", "pattern": "^[A-Za-z0-9_.:-]+$"},
    }


def position(flag: str) -> dict[str, Any]:
    required = {"x": NUMBER, "y": NUMBER, "theta": ANGLE, "mapId": TEXT, flag: FLAG}
    return strict(required, SCORE | DEVIATION)


def state_facts(error_levels: list[str]) -> dict[str, Any]:
    required = {"errorType": TEXT, "errorLevel": {"enum": error_levels}}
    error = strict(required, {"errorDescription": TEXT})
    return {
        "orderId": TEXT,
        "orderUpdateId": COUNTER,
        "lastNodeId": TEXT,
        "lastNodeSequenceId": COUNTER,
        "driving": FLAG,
        "nodeStates": NONE,
        "edgeStates": NONE,
        "actionStates": NONE,
        "operatingMode": {"enum": ["AUTOMATIC", "SEMIAUTOMATIC", "MANUAL", "SERVICE"]},
        "errors": {"type": "array", "items": error},
    }


def safety(name: str, values: list[str]) -> dict[str, Any]:
    return strict({name: {"enum": values}, "fieldViolation": FLAG})


HEADER_2, HEADER_3 = header("2", 2), header("3", 3)
POSITION_2 = {"agvPosition": position("positionInitialized")}
POSITION_3 = {"mobileRobotPosition": position("localized")}
REQUIRED = {
    "2.1": {
        "connection": strict(
            HEADER_2 | {"connectionState": {"enum": ["ONLINE", "OFFLINE", "CONNECTIONBROKEN"]}}
        ),
        "visualization": strict(HEADER_2, POSITION_2),
        "state": strict(
            HEADER_2
            | state_facts(["WARNING", "FATAL"])
            | {
                "batteryState": strict({"batteryCharge": NUMBER, "charging": FLAG}),
                "safetyState": safety("eStop", ["AUTOACK", "MANUAL", "REMOTE", "NONE"]),
            },
            POSITION_2,
        ),
    },
    "3.0": {
        "connection": strict(
            HEADER_3
            | {
                "connectionState": {
                    "enum": ["ONLINE", "OFFLINE", "HIBERNATING", "CONNECTION_BROKEN"]
                }
            }
        ),
        "visualization": strict(HEADER_3 | {"referenceStateHeaderId": COUNTER}, POSITION_3),
        "state": strict(
            HEADER_3
            | state_facts(["WARNING", "URGENT", "CRITICAL", "FATAL"])
            | {
                "instantActionStates": NONE,
                "powerSupply": strict({"stateOfCharge": NUMBER, "charging": FLAG}),
                "safetyState": safety("activeEmergencyStop", ["MANUAL", "REMOTE", "NONE"]),
            },
            POSITION_3,
        ),
    },
}
"""Required fields of the published schemas, and the optional ones that locatk sends."""


def check(version: str, name: str, message: dict[str, Any]) -> None:
    Draft202012Validator(REQUIRED[version][name]).validate(message)


@pytest.mark.parametrize("version", ["2.1", "3.0"])
def test_messages_have_the_required_fields(live: ModuleType, version: str) -> None:
    vehicle = Interface(version).vehicle("robot 1/ä")
    check(version, "state", vehicle.state(live.EPOCH_NS))
    check(version, "visualization", vehicle.visualization(live.EPOCH_NS))
    for event in (live.pose(1), live.position_only(), live.lost()):
        vehicle.update(event)
        check(version, "state", vehicle.state(live.EPOCH_NS))
        check(version, "visualization", vehicle.visualization(live.EPOCH_NS))
    for state in ("ONLINE", "OFFLINE", "CONNECTION_BROKEN"):
        check(version, "connection", vehicle.connection(state, live.EPOCH_NS))


@pytest.mark.parametrize(
    ("version", "place", "flag"),
    [("2.1", "agvPosition", "positionInitialized"), ("3.0", "mobileRobotPosition", "localized")],
)
def test_position(live: ModuleType, version: str, place: str, flag: str) -> None:
    vehicle = Interface(version, map_id="").vehicle("robot")
    vehicle.update(live.pose(7))
    found = vehicle.visualization(live.EPOCH_NS)[place]
    assert (found["x"], found["y"], found["mapId"]) == (7.0, 0.5, "floor")
    assert found["theta"] == pytest.approx(0.4)
    assert found["deviationRange"] == pytest.approx(0.01 * math.sqrt(5.991), abs=1e-4)
    assert found["localizationScore"] == pytest.approx(math.exp(-0.0245), abs=1e-3)
    assert found[flag] is True
    vehicle.update(live.pose(8, state=TrackingState.PROVISIONAL))
    found = vehicle.visualization(live.EPOCH_NS)[place]
    assert (found[flag], found["localizationScore"]) == (False, 0.5)
    vehicle.update(live.pose(9, state=TrackingState.DEAD_RECKONING))
    assert vehicle.visualization(live.EPOCH_NS)[place][flag] is True
    assert vehicle.state(live.EPOCH_NS)["errors"] == []
    vehicle.update(live.lost())
    found = vehicle.visualization(live.EPOCH_NS)[place]
    assert (found["x"], found[flag], found["localizationScore"]) == (9.0, False, 0.0)
    (error,) = vehicle.state(live.EPOCH_NS)["errors"]
    assert error["errorLevel"] == "FATAL"
    named = Interface(version, map_id="hall 3").vehicle("robot")
    named.update(live.pose())
    assert named.visualization(live.EPOCH_NS)[place]["mapId"] == "hall 3"


def test_topics_and_header_ids(live: ModuleType) -> None:
    old = Interface("2.1", "ACME Robots").vehicle("robot 1")
    assert old.topic("state") == "uagv/v2/ACME_Robots/robot_1/state"
    new = Interface("3.0", prefix="hall/fleet").vehicle("robot.1")
    assert new.topic("state") == "hall/fleet/v3/locatk/robot.1/state"
    assert Interface("3.0").vehicle("a").topic("x") == "vda5050/v3/locatk/a/x"
    ids = [old.visualization(0)["headerId"] for _ in range(3)]
    assert [*ids, old.state(0)["headerId"]] == [1, 2, 3, 1]
    reference = [new.state(0)["headerId"], new.visualization(0)["referenceStateHeaderId"]]
    assert reference == [1, 1]


def test_driving(live: ModuleType) -> None:
    def vehicle(step_m: float, count: int) -> bool:
        moving = Interface().vehicle("robot")
        for k in range(count):
            moving.update(live.pose(k, position=np.array([step_m * k, 0.0, 0.0])))
        driving: bool = moving.state(0)["driving"]
        return driving

    assert vehicle(0.001, 100)  # 0.1 m/s
    assert not vehicle(0.0001, 500)  # 10 mm/s is noise
    moving = Interface().vehicle("robot")
    for k in range(300):
        moving.update(live.pose(k, position=np.array([min(k, 100) * 0.01, 0.0, 0.0])))
    assert not moving.state(0)["driving"]


@pytest.mark.parametrize(
    ("time_ns", "decimals", "text"),
    [
        (1_764_000_000_009_999_999, 2, "2025-11-24T16:00:00.00Z"),
        (1_764_000_000_129_999_999, 3, "2025-11-24T16:00:00.129Z"),
        (1_764_000_000_000_000_000, 3, "2025-11-24T16:00:00.000Z"),
    ],
)
def test_timestamp(time_ns: int, decimals: int, text: str) -> None:
    assert timestamp(time_ns, decimals) == text


def test_sanitise() -> None:
    assert sanitise("robot-1.a:b_c") == "robot-1.a:b_c"
    assert sanitise("röbot/1+#") == "r_bot_1__"
    assert sanitise("") == "_"


def test_radius_contains_95_percent(live: ModuleType) -> None:
    rng = np.random.default_rng(1)
    for ratio in (1.0, 3.0, 20.0):
        angle = rng.uniform(0, math.pi)
        cosine, sine = math.cos(angle), math.sin(angle)
        rotation = np.array([[cosine, -sine], [sine, cosine]])
        covariance = np.eye(6)
        covariance[:2, :2] = rotation @ np.diag([1.0, 1 / ratio]) @ rotation.T
        points = rng.multivariate_normal([0, 0], covariance[:2, :2], 20_000)
        radius = deviation_radius_m(live.pose(covariance=covariance))
        inside = np.mean(np.hypot(*points.T) < radius)
        assert inside > 0.945
        assert ratio > 1 or inside < 0.955


def test_score_falls_with_uncertainty(live: ModuleType) -> None:
    scores = [localization_score(live.pose(covariance=np.eye(6) * v)) for v in (0, 1e-2, 1, 100)]
    assert scores[0] == 1
    assert scores == sorted(scores, reverse=True)
    assert localization_score(live.pose(covariance=np.full((6, 6), math.nan))) == 0
    assert localization_score(live.pose(covariance=np.eye(6) * 0, probability=0.3)) == 0.3
