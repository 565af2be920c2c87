"""Result of the importers of Lighthouse recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import StationReport, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.trajectory import Trajectory


@dataclass(frozen=True)
class ImportedSession:
    """Imported Lighthouse recording.

    Attributes
    ----------
    sweeps : Sweeps
        Ascending in time.
    scene : Scene or None
        Markers with their visits, calibrations and stations in the recording; None without any.
    truth : list of Trajectory
        One a device, under the names of the sweeps' devices.
    facts : dict of str to str
        Source and assumptions, as text.
    warnings : list of str
        Losses and doubts, one line each.
    stations : tuple of StationReport
        Measurements of each station, ascending in channel.
    receivers : dict of str to Receiver
        Layout of the photodiodes of each device.
    lost : str or None
        Summary of the losses in one line. If there are any, the exit status is 3.
    imu : tuple of InertialSamples
    onboard : tuple of Trajectory
        Poses that the devices estimated themselves, for comparison.
    """

    sweeps: Sweeps
    scene: Scene | None
    truth: list[Trajectory]
    facts: dict[str, str]
    warnings: list[str]
    stations: tuple[StationReport, ...] = ()
    receivers: Mapping[str, Receiver] = field(default_factory=dict)
    lost: str | None = None
    imu: tuple[InertialSamples, ...] = ()
    onboard: tuple[Trajectory, ...] = ()
