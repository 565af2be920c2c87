"""Live localization on printed dots: each frame on its own, without a first guess.

A frame passes the stages of the offline solver, and has the pose that the solver gives to a
recording of this frame alone. (In a batch, the solver decodes all frames in windows of the size of
the largest, which in rare cases decides whether a frame is accepted.) The causes of rejections that
a setting removes are searched in one rejected frame at a time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import CODEC_NAMES, codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import (
    NO_CODE,
    TOO_FEW_DOTS,
    LocalizedFrames,
    localize_frames,
    unlocalized_frames,
)
from locatk.core.dots.localization.recordings import (
    EXPLAINED,
    OFF_SHEET,
    RESTORATIONS,
    batches,
    find_sheets,
    localize_batch,
)
from locatk.core.dots.localization.seams import relocalize_at_seams
from locatk.core.dots.localization.sheet_poses import (
    frame_detections,
    sheet_poses,
    spatial_covariance,
)
from locatk.core.dots.sheet import Manifest
from locatk.core.dots.solver import RECOGNIZED_FRAMES, SolveOptions
from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    DetectionEvent,
    Fix,
    StateChange,
    Stream,
    StreamEvent,
    TrackingState,
    WarningEvent,
)

Images = NDArray[np.uint8]

TRIAL_INTERVAL_NS, LATER_TRIAL_INTERVAL_NS = 100_000_000, 1_000_000_000
"""Least time between two rejected frames in which another cause is searched [ns], at first and
after :data:`FIRST_CYCLES`. A search takes up to twice as long as the localization of a rejected
frame."""

FIRST_CYCLES = 2
"""Number of trials of each cause at first. A setting of the camera is wrong from the beginning."""

MIN_FRAMES_OF_OTHER_CODEC = 2
"""Number of frames that another codec locates on a sheet of the manifest before that is reported.
One alone has a probability of up to 0.001 to be wrong."""

MIN_FRAMES_WITHOUT_CODE = 100
"""Number of rejected frames, if most of them have no code, from which on a warning says so."""


@dataclass
class _CameraState:
    """What is remembered of one camera.

    Attributes
    ----------
    reason : str
        Of the last reported rejection; ``""`` after a localized frame.
    altered : str
        Cause that explained the last rejected frames, one of :data:`.RESTORATIONS`.
    next_trial_ns : int or None
        Time of a frame from which on the next cause is tried; None at once.
    trials : int
        Number of causes that were tried.
    localized : int
        Number of localized frames.
    rejected : Counter
        Number of rejected frames by reason.
    other_codecs : Counter
        Number of frames that another codec locates on a sheet, by its name.
    warned : set of str
        Codes of the warnings that were given.
    """

    reason: str = ""
    altered: str = ""
    next_trial_ns: int | None = None
    trials: int = 0
    localized: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    other_codecs: Counter[str] = field(default_factory=Counter)
    warned: set[str] = field(default_factory=set)


class DotsStream(Stream):
    """Causal solver of printed dots for any number of cameras; see :class:`.events.Stream`.

    Each frame gives a fix and a detection, or is rejected. The reason of a rejection is reported
    when it differs from that of the previous frame. Errors of the floor, which all frames on a
    sheet share, are the common part of the covariance.

    Parameters
    ----------
    manifest : Manifest
    options : SolveOptions, optional
        Only the method ``"lattice"`` estimates covariances and is available.

    Raises
    ------
    InputError
        The method or the codec of the manifest cannot be used.
    """

    system = "dots"

    def __init__(self, manifest: Manifest, options: SolveOptions | None = None) -> None:
        options = options or SolveOptions()
        if options.method != "lattice":
            raise InputError(
                f"no method {options.method!r} for live poses on dots", hint="Known: lattice"
            )
        self._manifest, self._camera = manifest, options.camera
        self._code = codec(manifest.codec)
        other_codecs = [name for name in CODEC_NAMES if name != manifest.codec]
        self._causes = (*RESTORATIONS, *other_codecs)
        self._cameras: dict[str, _CameraState] = {}

    @property
    def rejected(self) -> dict[str, int]:
        """Number of rejected frames of all cameras by reason."""
        total: Counter[str] = Counter()
        for state in self._cameras.values():
            total.update(state.rejected)
        return dict(sorted(total.items()))

    def push(self, observations: Any) -> Sequence[StreamEvent]:
        """Return the results of the next frames; odometry and IMUs are of no use here."""
        events: list[StreamEvent] = []
        if isinstance(observations, Frames):
            for index in range(len(observations)):
                events += self._localize(_single(observations, index))
        return events

    # ---- one frame

    def _localize(self, frame: Frames) -> list[StreamEvent]:
        """Return the results of a single frame."""
        manifest, camera = self._manifest, self._camera
        is_first = frame.device not in self._cameras
        state = self._cameras.setdefault(frame.device, _CameraState())
        events: list[StreamEvent] = []
        if is_first and camera is None:
            message = (
                "no camera model: poses are of the middle of the frame, its lens estimated anew in "
                "each"
            )
            events += _warn(state, frame, "no_camera_model", message)
        localized = unlocalized_frames(1, TOO_FEW_DOTS)
        images: Images | None = None
        for index, images in batches(frame, np.arange(1), localized.rejected, camera):
            localized.update(index, localize_batch(images, manifest, self._code, camera))
        sheet = find_sheets(localized, manifest)
        if images is not None and manifest.has_seams:
            relocalize_at_seams(frame, localized, sheet, manifest, self._code, camera)
        if sheet[0] >= 0:
            return events + self._fix(frame, localized, sheet, state)
        return events + self._reject(frame, localized, images, state)

    def _fix(
        self,
        frame: Frames,
        localized: LocalizedFrames,
        sheet: NDArray[np.intp],
        state: _CameraState,
    ) -> list[StreamEvent]:
        """Return the fix and the detection of a localized frame."""
        manifest, number = self._manifest, int(sheet[0])
        state.localized += 1
        state.reason = state.altered = ""
        poses = sheet_poses(localized, sheet, manifest)
        (detection,) = frame_detections(frame, localized, sheet, poses, manifest)
        time_ns = int(frame.time_ns[0])
        common = manifest.covariance(number, poses.position[0])
        fix = Fix(
            device=frame.device,
            frame=manifest.frame(number),
            time_ns=time_ns,
            position=np.append(poses.position[0], 0.0),
            quaternion=quaternion_from_heading(poses.heading[0]),
            covariance=spatial_covariance(poses.covariance[0]),
            common_covariance=spatial_covariance(common) if common.any() else None,
            probability=float(localized.confidence[0]),
        )
        return [DetectionEvent(frame.device, time_ns, detection), fix]

    def _reject(
        self,
        frame: Frames,
        localized: LocalizedFrames,
        images: Images | None,
        state: _CameraState,
    ) -> list[StreamEvent]:
        """Return the reason of a rejected frame if it is another one, and new warnings."""
        reason, time_ns = str(localized.rejected[0]), int(frame.time_ns[0])
        events: list[StreamEvent] = []
        is_unexplained = reason not in EXPLAINED
        if images is not None and (is_unexplained or reason == OFF_SHEET):
            events += self._search_cause(frame, images, is_unexplained, state)
            if is_unexplained and state.altered:
                reason = state.altered
        state.rejected[reason] += 1
        if reason == OFF_SHEET and not state.other_codecs:
            x, y = localized.grid[0]
            message = (
                f"a frame shows the pattern off all sheets of the manifest, at {x:.1f}, {y:.1f}: "
                "is it the manifest of another sheet?"
            )
            events += _warn(state, frame, "frames_off_sheet", message)
        total = sum(state.rejected.values())
        if total >= MIN_FRAMES_WITHOUT_CODE and state.rejected[NO_CODE] > total // 2:
            message = (
                f"{state.rejected[NO_CODE]} frames show no place of the codec "
                f"{self._manifest.codec!r}: no pattern in sight, or a sheet printed with another "
                "codec"
            )
            events += _warn(state, frame, "frames_without_code", message)
        if reason != state.reason:
            state.reason = reason
            events.append(StateChange(frame.device, time_ns, TrackingState.LOST, reason))
        return events

    # ---- causes of rejections

    def _search_cause(
        self, frame: Frames, images: Images, is_unexplained: bool, state: _CameraState
    ) -> list[StreamEvent]:
        """Try the next cause on a rejected frame, if the last trial is long enough ago."""
        time_ns = int(frame.time_ns[0])
        if state.altered or (state.next_trial_ns is not None and time_ns < state.next_trial_ns):
            return []
        cause = self._causes[state.trials % len(self._causes)]
        if not is_unexplained and cause in RESTORATIONS:
            # A frame off the sheet was decoded: only its codec is in doubt.
            state.trials += len(RESTORATIONS) - state.trials % len(self._causes)
            cause = self._causes[state.trials % len(self._causes)]
        state.trials += 1
        is_early = state.trials <= FIRST_CYCLES * len(self._causes)
        state.next_trial_ns = time_ns + (TRIAL_INTERVAL_NS if is_early else LATER_TRIAL_INTERVAL_NS)
        if cause in RESTORATIONS:
            restored = np.ascontiguousarray(RESTORATIONS[cause](images))
            if not localize_frames(restored, self._code, self._camera).accepted[0]:
                return []
            state.altered = cause
            code, appearance, remedy = RECOGNIZED_FRAMES[cause]
            message = f"frames are {appearance} and have no pose: {remedy}"
            return _warn(state, frame, code, message)
        part = localize_frames(images, codec(cause), self._camera, other_codec_odds=0)
        if find_sheets(part, self._manifest)[0] < 0:
            return []
        state.other_codecs[cause] += 1
        if state.other_codecs[cause] < MIN_FRAMES_OF_OTHER_CODEC:
            return []
        return self._warn_of_codec(frame, cause, state)

    def _warn_of_codec(self, frame: Frames, name: str, state: _CameraState) -> list[StreamEvent]:
        """Return the warning that frames are of another codec, if it was not given yet."""
        count = state.other_codecs[name]
        if state.localized >= sum(state.rejected.values()):
            message = (
                f"with the codec {name!r}, {count} of the rejected frames that were tried are on "
                f"the sheets, but {state.localized} frames are of the codec "
                f"{self._manifest.codec!r}: do these frames show a sheet of another manifest?"
            )
        else:
            message = (
                f"the sheets were printed with the codec {name!r}, not {self._manifest.codec!r} as "
                f"in the manifest: with it, {count} of the rejected frames that were tried are on "
                "the sheets. Correct the codec in the manifest"
            )
        return _warn(state, frame, "other_codec", message)


def _single(frames: Frames, index: int) -> Frames:
    """Return one frame of a camera; its image is loaded on access."""
    part = slice(index, index + 1)
    return Frames(frames.device, frames.time_ns[part], frames.names[part], _View(frames, index))


class _View(Sequence[Any]):
    """Sequence of the single image of a frame, which is loaded once."""

    def __init__(self, frames: Frames, index: int) -> None:
        self._frames, self._index = frames, index
        self._image: Any = None

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: Any) -> Any:
        if self._image is None:
            self._image = self._frames.images[self._index]
        return self._image


def _warn(state: _CameraState, frame: Frames, code: str, message: str) -> list[StreamEvent]:
    """Return a warning, if it is the first with its code for the camera."""
    if code in state.warned:
        return []
    state.warned.add(code)
    warning = SolverWarning(code, message)
    return [WarningEvent(frame.device, int(frame.time_ns[0]), warning)]
