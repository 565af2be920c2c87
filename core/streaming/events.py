"""Results of causal localization, in the order in which they become known."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]


class TrackingState(StrEnum):
    """State of the localization of one device."""

    TRACKING = "tracking"
    """The pose rests on a recent fix."""
    PROVISIONAL = "provisional"
    """The pose may be that of another position that the observations fit as well."""
    DEAD_RECKONING = "dead reckoning"
    """The pose was carried by odometry or an IMU since a fix; its covariance grows."""
    LOST = "lost"
    """There is no pose."""


@dataclass(frozen=True, slots=True)
class Fix:
    """Pose of a device by its infrastructure alone, at one time.

    Attributes
    ----------
    device : str
    frame : str
        Name of the frame of the pose, as in ``"floor"``.
    time_ns : int
        Time of the pose, nanoseconds since the epoch. It may be earlier than that of the
        observation that completed the fix.
    position : (3,) ndarray
        In metres.
    quaternion : (4,) ndarray
        Orientation from device to frame as (x, y, z, w).
    covariance : (6, 6) ndarray
        Of (x, y, z, rotation about x, y, z) in m and rad, in the axes of the frame, errors common
        to all fixes included; ``nan`` in the rows and columns of unobserved components.
    common_covariance : (6, 6) ndarray or None
        The part of ``covariance`` that successive fixes share (calibration, scene), which no
        averaging reduces. None if errors of fixes are independent.
    probability : float
        Posterior probability that the pose is right within its covariance; nan if unknown.
    """

    device: str
    frame: str
    time_ns: int
    position: Array
    quaternion: Array
    covariance: Array
    common_covariance: Array | None = None
    probability: float = math.nan


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """Pose of a device for its user: a fix, or one that was carried from earlier fixes.

    Attributes
    ----------
    device, frame, time_ns, position, quaternion, covariance, probability
        As in :class:`Fix`.
    state : TrackingState
        Never ``LOST``: a lost device has no pose, see :class:`StateChange`.
    reason : str
        Why the state is not ``TRACKING``, in a few words; else ``""``.
    reset_counter : int
        Increases by one with each discontinuity of the poses (a jump of the pose, another scene),
        modulo 256.
    """

    device: str
    frame: str
    time_ns: int
    position: Array
    quaternion: Array
    covariance: Array
    probability: float = math.nan
    state: TrackingState = TrackingState.TRACKING
    reason: str = ""
    reset_counter: int = 0

    @property
    def sigma(self) -> Array:
        """Standard deviations (6,) in m and rad; ``nan`` for unobserved components."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def has_orientation(self) -> bool:
        """Return whether the orientation is known; see :func:`.trajectory.has_orientation`."""
        return bool(np.isfinite(self.covariance[5, 5]))


@dataclass(frozen=True, slots=True)
class StateChange:
    """Change of the state of a device.

    Attributes
    ----------
    device : str
    time_ns : int
    state : TrackingState
    reason : str
        In a few words; ``""`` for ``TRACKING``.
    """

    device: str
    time_ns: int
    state: TrackingState
    reason: str = ""


@dataclass(frozen=True, slots=True)
class DetectionEvent:
    """Infrastructure that was detected, identified or refused.

    Attributes
    ----------
    device : str
    time_ns : int
    detection : dataclass
        ``TagDetection``, ``HeadingCorrection``, ``LandmarkDetection``, ``DotDetection`` or
        ``StationDetection``.
    """

    device: str
    time_ns: int
    detection: Any


@dataclass(frozen=True, slots=True)
class Correction:
    """Discontinuity of the poses of a device: earlier poses are not retracted.

    Attributes
    ----------
    device : str
    time_ns : int
    displacement_m : (3,) ndarray
        New pose minus the predicted one, in the frame.
    rotation_rad : float
        About the vertical axis; nan if unknown.
    reason : str
        As in ``"tag 77"``, ``"scene version 2"``.
    """

    device: str
    time_ns: int
    displacement_m: Array
    rotation_rad: float
    reason: str


@dataclass(frozen=True, slots=True)
class ArtifactUpdate:
    """New version of the artifact that later poses refer to, such as a scene that was refined.

    Attributes
    ----------
    time_ns : int
    version : int
        From 1.
    artifact : object
        As ``Solution.artifact``.
    reason : str
    """

    time_ns: int
    version: int
    artifact: Any
    reason: str = ""


@dataclass(frozen=True, slots=True)
class WarningEvent:
    """Assumption or doubt that the user must know; each is reported once.

    Attributes
    ----------
    device : str
        ``""`` if it is of no one device.
    time_ns : int
    warning : SolverWarning
    """

    device: str
    time_ns: int
    warning: SolverWarning


StreamEvent = Fix | DetectionEvent | StateChange | ArtifactUpdate | WarningEvent
"""Results of the stream of a system."""

LiveEvent = PoseEstimate | DetectionEvent | StateChange | Correction | ArtifactUpdate | WarningEvent
"""Results for the user."""


@dataclass(frozen=True)
class BackgroundTask:
    """Long computation that a stream wants to be done elsewhere, such as the estimate of a scene.

    Attributes
    ----------
    name : str
        As in ``"scene"``.
    function : callable
        A function at the top level of a module (it is pickled), without side effects.
    arguments : tuple
        Its arguments, which can be pickled.
    """

    name: str
    function: Any
    arguments: tuple[Any, ...] = field(default_factory=tuple)


class Stream(ABC):
    """Causal solver of one system, for any number of devices.

    Attributes
    ----------
    system : str
        As in :class:`locatk.core.solution.Solution`.
    """

    system: ClassVar[str]

    @property
    def rejected(self) -> Mapping[str, int]:
        """Number of observations that were not used, by reason."""
        return {}

    @abstractmethod
    def push(self, observations: Any) -> Sequence[StreamEvent]:
        """Return the results that the next observations make known.

        Parameters
        ----------
        observations : Sweeps, Samples, HallSamples, Frames, Trajectory or InertialSamples
            A trajectory is odometry. The newest of their kind, in the order of time within a
            device. They may be cut into pieces of any size: the results are the same.
        """

    def advance(self, time_ns: int) -> Sequence[StreamEvent]:
        """Return the results that follow from the time alone: no observation up to it is missing.

        Sensors that fell silent become known this way.
        """
        return ()

    def finish(self) -> Sequence[StreamEvent]:
        """Return the results of observations that were held back, at the end of the input."""
        return ()

    def background_task(self) -> BackgroundTask | None:
        """Return the next long computation to be done, once; None if there is none."""
        return None

    def complete(self, task: BackgroundTask, result: Any) -> Sequence[StreamEvent]:
        """Take the result of a task, or the exception that it raised."""
        return ()
