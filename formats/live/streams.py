"""Streams of the systems, from the artifacts of a live session."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from locatk.core.errors import InputError
from locatk.core.streaming.events import Stream
from locatk.formats.artifacts.maps import MAP
from locatk.formats.artifacts.receiver import RECEIVER
from locatk.formats.artifacts.registry import attached_artifact
from locatk.formats.artifacts.scene import SCENE
from locatk.formats.artifacts.schema import Artifact
from locatk.formats.artifacts.sheets import CAMERA, MANIFEST
from locatk.formats.artifacts.tags import TAGS
from locatk.formats.live.observations import AttachedArtifacts

INFRASTRUCTURE: dict[str, Artifact[Any]] = {
    "lighthouse": SCENE,
    "dots": MANIFEST,
    "polaris": TAGS,
    "landmarks": MAP,
}
"""Artifact of the infrastructure of each system."""


@dataclass(frozen=True)
class StreamOptions:
    """Options of the solvers; None selects their defaults, as in ``locatk solve``."""

    scene: str | None = None
    odometry_noise_rad: float | None = None
    odometry_lag_s: float | None = None


def system_of_artifacts(texts: Mapping[str, str]) -> str:
    """Return the system that the attachments (name to text) are of; ``""`` without any.

    Raises
    ------
    InputError
        They are of several systems.
    """
    systems = {entry.system for name in texts if (entry := attached_artifact(name)) is not None}
    if len(systems) > 1:
        raise InputError(
            f"artifacts of {' and '.join(sorted(systems))}",
            hint="Give those of one system; start `locatk live` once for each",
        )
    return systems.pop() if systems else ""


def create_stream(
    system: str, inputs: Sequence[AttachedArtifacts], options: StreamOptions
) -> tuple[Stream, dict[str, Any]]:
    """Return the stream of a system, and its artifacts by name.

    Raises
    ------
    InputError
        An artifact that the system requires is missing.
    """
    kind = INFRASTRUCTURE[system]
    infrastructure = _first(kind.attached(each) for each in inputs)
    artifacts = {} if infrastructure is None else {kind.file: infrastructure}
    stream: Stream
    if system == "lighthouse":
        from locatk.core.lighthouse.solver import SolveOptions as LighthouseOptions
        from locatk.core.lighthouse.stream import LighthouseStream

        lighthouse_options = LighthouseOptions(**_given(scene=options.scene))
        stream = LighthouseStream(
            infrastructure,
            lambda device: _first(each.of_device(RECEIVER, device) for each in inputs),
            lighthouse_options,
        )
    elif system == "dots":
        from locatk.core.dots.solver import SolveOptions as DotsOptions
        from locatk.core.dots.stream import DotsStream

        if infrastructure is None:
            raise InputError("no manifest of the sheet", hint="Give it as --artifact sheet.toml")
        camera = _first(CAMERA.attached(each) for each in inputs)
        stream = DotsStream(infrastructure, DotsOptions(camera=camera))
    elif system == "polaris":
        from locatk.core.polaris.stream import PolarisStream

        stream = PolarisStream(infrastructure)
    else:
        from locatk.core.landmarks.solver import SolveOptions as LandmarkOptions
        from locatk.core.landmarks.stream import LandmarksStream

        landmark_options = LandmarkOptions(
            **_given(
                odometry_noise=options.odometry_noise_rad,
                odometry_lag_s=options.odometry_lag_s,
            )
        )
        stream = LandmarksStream(infrastructure, landmark_options)
    return stream, artifacts


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _first(artifacts: Iterable[Any]) -> Any:
    return next((each for each in artifacts if each is not None), None)
