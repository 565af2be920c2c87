"""What an importer of Lighthouse recordings answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import StationReport, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.trajectory import Trajectory


@dataclass(frozen=True)
class ImportedSession:
    """A recording of others.

    Attributes
    ----------
    sweeps : Sweeps
        Ascending in time.
    scene : Scene or None
        What the recording tells of the place: markers with their sightings, calibrations,
        stations; None where it tells nothing.
    truth : list of Trajectory
        One a device, under the names of the sweeps' devices.
    facts : dict of str to str
        What was read and assumed, for people.
    warnings : list of str
        What was lost or is doubtful, one line each.
    stations : tuple of StationReport
        What was measured of each station, ascending in channel.
    receivers : dict of str to Receiver
        By device, where its photodiodes sit.
    lost : str or None
        What was left out of the recording, in one line: the exit status is 3 then.
    """

    sweeps: Sweeps
    scene: Scene | None
    truth: list[Trajectory]
    facts: dict[str, str]
    warnings: list[str]
    stations: tuple[StationReport, ...] = ()
    receivers: Mapping[str, Receiver] = field(default_factory=dict)
    lost: str | None = None
