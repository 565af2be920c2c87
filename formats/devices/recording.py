"""What a session holds, for a device that is emulated: arrays that become bytes again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from locatk.core.landmarks.halls import HallSamples
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.polaris.array import Samples
from locatk.core.trajectory import Trajectory


@dataclass(frozen=True)
class Recording:
    """Observations of a session; empty or None where it has none of a kind."""

    samples: Sequence[Samples] = ()
    halls: Sequence[HallSamples] = ()
    sweeps: Sweeps | None = None
    odometry: Sequence[Trajectory] = ()
