"""Messages of VDA 5050 (versions 2.1 and 3.0) of a vehicle whose pose is known and little else.

https://github.com/VDA5050/VDA5050 has the specification and the schemas of each version.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from locatk.core.geometry import heading_from_quaternion
from locatk.core.streaming.events import PoseEstimate, StateChange, TrackingState
from locatk.formats.sinks.confidence import deviation_radius_m, localization_score

MIN_DISPLACEMENT_M = 0.02
"""Displacement within :data:`DRIVING_WINDOW_NS` from which a vehicle counts as driving: above the
noise of a standing one."""

DRIVING_WINDOW_NS = 1_000_000_000

_FULL_VERSIONS = {"2.1": "2.1.0", "3.0": "3.0.0"}
VERSIONS = tuple(_FULL_VERSIONS)

_DEFAULT_PREFIXES = {"2.1": "uagv", "3.0": "vda5050"}


@dataclass(frozen=True)
class Interface:
    """Facts that all vehicles of a sink share.

    Attributes
    ----------
    version : {"2.1", "3.0"}
    manufacturer : str
    map_id : str
        ``""``: the frame of the poses.
    prefix : str
        First level of the topics; ``""`` for that of the specification.
    """

    version: str = "2.1"
    manufacturer: str = "locatk"
    map_id: str = ""
    prefix: str = ""

    def vehicle(self, device: str) -> Vehicle:
        """Return the vehicle of a device."""
        return Vehicle(self, device)


class Vehicle:
    """State of one vehicle and the messages on it.

    Its serial number is the name of the device; characters that VDA 5050 does not allow become
    ``_``.
    """

    def __init__(self, interface: Interface, device: str) -> None:
        self.serial_number = sanitise(device)
        self._interface = interface
        self._is_v3 = interface.version == "3.0"
        self._header_ids = {"connection": 0, "visualization": 0, "state": 0}
        self._pose: PoseEstimate | None = None
        self._state = TrackingState.LOST
        self._reference: PoseEstimate | None = None
        self._moved_ns: int | None = None

    def update(self, event: PoseEstimate | StateChange) -> None:
        """Take a pose or a change of the state."""
        self._state = event.state
        if isinstance(event, PoseEstimate):
            self._pose = event
            self._update_motion(event)

    def topic(self, name: str) -> str:
        """Return the topic of ``"connection"``, ``"state"`` or ``"visualization"``."""
        facts = self._interface
        prefix = facts.prefix or _DEFAULT_PREFIXES[facts.version]
        major = facts.version.partition(".")[0]
        manufacturer = sanitise(facts.manufacturer)
        return f"{prefix}/v{major}/{manufacturer}/{self.serial_number}/{name}"

    def connection(self, state: str, time_ns: int) -> dict[str, Any]:
        """Return the message on ``ONLINE``, ``OFFLINE`` or ``CONNECTION_BROKEN``."""
        if state == "CONNECTION_BROKEN" and not self._is_v3:
            state = "CONNECTIONBROKEN"
        return self._header("connection", time_ns) | {"connectionState": state}

    def visualization(self, time_ns: int) -> dict[str, Any]:
        """Return the message with the newest pose."""
        message = self._header("visualization", time_ns)
        if self._is_v3:
            message["referenceStateHeaderId"] = self._header_ids["state"]
        return message | self._position()

    def state(self, time_ns: int) -> dict[str, Any]:
        """Return the message with the newest pose, no order, and no battery that is known."""
        message = self._header("state", time_ns)
        message |= {
            "orderId": "",
            "orderUpdateId": 0,
            "lastNodeId": "",
            "lastNodeSequenceId": 0,
            "driving": self._is_driving(),
            "nodeStates": [],
            "edgeStates": [],
            "actionStates": [],
            "operatingMode": "MANUAL",
            "errors": [] if self._is_localized() else [self._localization_error()],
        }
        if self._is_v3:
            message |= {
                "instantActionStates": [],
                "powerSupply": {"stateOfCharge": 0.0, "charging": False},
                "safetyState": {"activeEmergencyStop": "NONE", "fieldViolation": False},
            }
        else:
            message |= {
                "batteryState": {"batteryCharge": 0.0, "charging": False},
                "safetyState": {"eStop": "NONE", "fieldViolation": False},
            }
        return message | self._position()

    def _header(self, name: str, time_ns: int) -> dict[str, Any]:
        self._header_ids[name] += 1
        return {
            "headerId": self._header_ids[name],
            "timestamp": timestamp(time_ns, 3 if self._is_v3 else 2),
            "version": _FULL_VERSIONS[self._interface.version],
            "manufacturer": self._interface.manufacturer,
            "serialNumber": self.serial_number,
        }

    def _is_localized(self) -> bool:
        return self._state in (TrackingState.TRACKING, TrackingState.DEAD_RECKONING)

    def _localization_error(self) -> dict[str, Any]:
        # The level of version 3.0: a vehicle that is not localized cannot go on without help.
        name = "LOCALIZATION_ERROR" if self._is_v3 else "localizationError"
        return {"errorType": name, "errorLevel": "FATAL", "errorDescription": str(self._state)}

    def _position(self) -> dict[str, Any]:
        pose = self._pose
        if pose is None:
            return {}
        heading = heading_from_quaternion(pose.quaternion) if pose.has_orientation else 0.0
        position = {
            "x": float(pose.position[0]),
            "y": float(pose.position[1]),
            "theta": float(heading),
            "mapId": self._interface.map_id or pose.frame,
            "localized" if self._is_v3 else "positionInitialized": self._is_localized(),
            "localizationScore": 0.0,
        }
        if self._state != TrackingState.LOST:
            position["localizationScore"] = round(localization_score(pose), 4)
        radius_m = deviation_radius_m(pose)
        if radius_m == radius_m:
            position["deviationRange"] = round(radius_m, 4)
        return {"mobileRobotPosition" if self._is_v3 else "agvPosition": position}

    def _update_motion(self, pose: PoseEstimate) -> None:
        reference = self._reference
        if reference is None:
            self._reference = pose
            return
        x_m, y_m = (pose.position - reference.position).tolist()[:2]
        if x_m * x_m + y_m * y_m > MIN_DISPLACEMENT_M**2:
            self._moved_ns = pose.time_ns
            self._reference = pose
        elif pose.time_ns - reference.time_ns > DRIVING_WINDOW_NS:
            self._reference = pose

    def _is_driving(self) -> bool:
        if self._pose is None or self._moved_ns is None:
            return False
        return self._pose.time_ns - self._moved_ns < DRIVING_WINDOW_NS


def sanitise(name: str) -> str:
    """Replace the characters that VDA 5050 does not allow in a serial number by ``_``."""
    return re.sub(r"[^A-Za-z0-9_.:-]", "_", name) or "_"


def timestamp(time_ns: int, decimals: int) -> str:
    """Return a time in UTC in ISO 8601 with 2 or 3 decimals of the second."""
    seconds, rest_ns = divmod(time_ns, 1_000_000_000)
    text = datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{text}.{rest_ns:09d}"[: 20 + decimals] + "Z"
