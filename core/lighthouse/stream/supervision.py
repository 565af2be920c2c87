"""Supervision of the stations of a known scene while devices are located in it.

A station is *hidden* if no device receives it for a while, although others are received. It is
*moved* if it disagrees with the others, which agree without it: by the verification of the offline
solver (:mod:`locatk.core.lighthouse.scene.verification`) on the last epochs of single photodiodes,
and for rigid devices if most of its sweeps contradict the poses. A moved station is left out of
fixes until it agrees again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.doubled_channels import (
    doubled_channel_message,
    find_doubled_channels,
    possible_doubled_channel_message,
)
from locatk.core.lighthouse.localization.photodiodes import MAX_INCONSISTENT_FRACTION
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import SceneVerification, StationDetection
from locatk.core.lighthouse.scene.verification import (
    MIN_INCONSISTENT_RESIDUAL_RAD,
    find_inconsistent_station,
    inconsistent_station_warnings,
    verify_stations,
)
from locatk.core.lighthouse.stream.known_scene import KnownScene
from locatk.core.lighthouse.stream.photodiodes import PhotodiodeFixes
from locatk.core.lighthouse.stream.rigid import RigidFixes
from locatk.core.robust import robust_sigma
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

HIDDEN_NS = 2_000_000_000
"""Time without a sweep of a station, while others are received, after which it is hidden [ns]."""

MAX_EPOCHS = 120
"""Number of epochs on which stations are verified: some seconds of one photodiode."""

MIN_EPOCHS = 40
"""Fewest epochs on which stations are verified."""

MIN_CONFIRMATIONS = 2
"""Successive verifications that must agree: a reflection lasts for a second."""

MIN_POSE_SWEEPS = 40
"""Fewest sweeps of a station over rigid devices between two verifications."""


class StationSupervision:
    """Watches the stations of a known scene.

    Attributes
    ----------
    last_ns : list of int
        By station, time of its last sweep; -1 if there was none.
    """

    def __init__(self, known: KnownScene) -> None:
        self.known = known
        n = len(known.stations)
        self.last_ns = [-1] * n
        self._is_hidden = [False] * n
        self._epochs: deque[Array] = deque(maxlen=MAX_EPOCHS)
        self._is_inconsistent: deque[bool] = deque(maxlen=4 * MAX_EPOCHS)
        self._votes = [0] * n
        self._pose_votes = [0] * n
        self._counted = [(0, 0)] * n
        self._is_contradicted = False

    def observe(self, angles: Array, is_solved: bool, is_inconsistent: bool) -> None:
        """Take the angles (s, 2) of a fix, accepted or not."""
        if is_solved:
            self._is_inconsistent.append(is_inconsistent)
        if np.count_nonzero(np.isfinite(angles[:, 0])) > 1:
            self._epochs.append(angles)

    def check_hidden(self, now_ns: int) -> list[SolverWarning]:
        """Return a warning for each station that became hidden."""
        warnings = []
        newest_ns = max(self.last_ns)
        for k, last_ns in enumerate(self.last_ns):
            is_hidden = 0 <= last_ns < now_ns - HIDDEN_NS and newest_ns > last_ns + HIDDEN_NS
            if is_hidden and not self._is_hidden[k]:
                warnings.append(
                    SolverWarning(
                        "station_hidden",
                        f"the station on channel {self.known.stations[k].channel} is not received "
                        "any more: it is hidden, switched off or on another channel",
                    )
                )
            self._is_hidden[k] = is_hidden
        return warnings

    # ---- moved stations

    def check_moved(self, rigid: RigidFixes) -> list[SolverWarning]:
        """Exclude stations that disagree with the others; return the warnings about them."""
        warnings = [*self._check_epochs(), *self._check_poses(rigid)]
        inconsistent = sum(self._is_inconsistent)
        is_contradicted = len(
            self._is_inconsistent
        ) >= MAX_EPOCHS and inconsistent > MAX_INCONSISTENT_FRACTION * len(self._is_inconsistent)
        if is_contradicted and not self._is_contradicted and not self.known.excluded:
            warnings.append(
                SolverWarning(
                    "scene_contradicted",
                    f"{inconsistent / len(self._is_inconsistent):.0%} of the last epochs "
                    "contradict the scene: a station was moved since, the scene is of another "
                    "site, or robots move too fast between sweeps",
                )
            )
        self._is_contradicted |= is_contradicted
        return warnings

    def _check_epochs(self) -> Sequence[SolverWarning]:
        """Verify the stations on the last epochs of single photodiodes."""
        if len(self._epochs) < MIN_EPOCHS or len(self.known.stations) < 3:
            return ()
        known = self.known
        angles = np.stack(self._epochs)
        self._epochs.clear()
        channels = [s.channel for s in known.stations]
        excluded = sorted(known.excluded)
        # An excluded station is compared with the others without taking part in their positions.
        checks = verify_stations(angles, channels, *known.arrays, floor_z=known.floor_z)
        found = find_inconsistent_station(checks)
        warnings: Sequence[SolverWarning] = ()
        for k, channel in enumerate(channels):
            is_found = found is not None and found.channel == channel
            self._votes[k] = self._votes[k] + 1 if is_found else 0
            if self._votes[k] == MIN_CONFIRMATIONS and k not in known.excluded:
                known.excluded.add(k)
                warnings = inconsistent_station_warnings(
                    SceneVerification(True, len(angles), tuple(checks))
                )
        for k in excluded:
            residual = checks[k].residual_rad
            if (
                residual is not None
                and checks[k].against == "others"
                and residual < MIN_INCONSISTENT_RESIDUAL_RAD
            ):
                known.excluded.discard(k)
        return warnings

    def _check_poses(self, rigid: RigidFixes) -> list[SolverWarning]:
        """Compare the sweeps of each station with the poses of rigid devices."""
        known = self.known
        totals = list(zip(rigid.used, rigid.rejected, strict=True))
        if sum(map(sum, totals)) - sum(map(sum, self._counted)) < MIN_POSE_SWEEPS:
            return []
        new = [
            (used - before[0], rejected - before[1])
            for (used, rejected), before in zip(totals, self._counted, strict=True)
        ]
        self._counted = totals
        is_wrong = [
            used < rejected and used + rejected >= MIN_POSE_SWEEPS for used, rejected in new
        ]
        is_right = [used > rejected for used, rejected in new]
        warnings = []
        for k, station in enumerate(known.stations):
            is_found = is_wrong[k] and any(is_right)
            self._pose_votes[k] = self._pose_votes[k] + 1 if is_found else 0
            if self._pose_votes[k] == MIN_CONFIRMATIONS and k not in known.excluded:
                known.excluded.add(k)
                warnings.append(
                    SolverWarning(
                        "station_contradicts_others",
                        f"most sweeps of the station on channel {station.channel} contradict the "
                        "other stations: it was moved after the scene was estimated, or received "
                        "by reflection",
                    )
                )
            elif k in known.excluded and is_right[k] and self._votes[k] == 0:
                known.excluded.discard(k)
        return warnings

    # ---- detections

    def detections(self, photodiodes: PhotodiodeFixes, rigid: RigidFixes) -> list[StationDetection]:
        """Return the sweeps and residuals of each station so far."""
        result = []
        for k, station in enumerate(self.known.stations):
            residual = [*photodiodes.residual[k], *rigid.residual[k]]
            result.append(
                StationDetection(
                    station=k,
                    channel=station.channel,
                    id=None if station.id is None else f"{station.id:08x}",
                    period_ticks=int(period_ticks(station.channel)),
                    calibration=station.calibration.source,
                    sweeps=photodiodes.used[k] + rigid.used[k],
                    rejected=photodiodes.rejected[k] + rigid.rejected[k],
                    residual_rad=robust_sigma(np.array(residual)) if residual else None,
                )
            )
        return result


def doubled_channel_warnings(sweeps: Sweeps) -> tuple[tuple[int, ...], list[SolverWarning]]:
    """Return the channels with more than one station, and the warnings about them, as offline."""
    channels = find_doubled_channels(sweeps)
    warnings = []
    if channels.proven:
        warnings.append(SolverWarning("doubled_channel", doubled_channel_message(channels.proven)))
    if channels.possible:
        warnings.append(
            SolverWarning(
                "possible_doubled_channel", possible_doubled_channel_message(channels.possible)
            )
        )
    return channels.proven, warnings
