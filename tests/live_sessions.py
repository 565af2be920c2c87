"""Short sessions for the tests of live localization: of each system, as raw bytes or frames."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner

from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.core.landmarks.simulation import session as landmarks
from locatk.core.polaris.simulation import session as polaris
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.formats.emulation.sources import select_source
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import field_samples
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

DEVICES = {
    "polaris": "locatk",
    "landmarks": "locatk",
    "lighthouse": "dotbot-gateway",
    "deck": "lighthouse-deck",
}
"""Device that sends the bytes of each session."""

RECEIVER = """format = "locatk-lighthouse-receiver"
format_version = 1
position_mm = [[0.0, 0.0, 0.0]]
"""
"""One photodiode that reports every sweep."""


class LiveSessions:
    """Sessions of 3 to 4 s, each made when it is needed: of each system, and of a rigid "deck".

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def decoded(self, system: str) -> Path:
        """Return a simulated session with artifacts and truth."""
        path = self.folder / f"{system}.mcap"
        if not path.exists():
            getattr(self, f"_{system}")(path)
        return path

    def artifacts(self, system: str) -> Path:
        """Return a session with the artifacts; those of Lighthouse have an estimated scene."""
        if system not in ("lighthouse", "deck"):
            return self.decoded(system)
        path = self.folder / f"{system}-solved.mcap"
        if not path.exists():
            locatk("solve", self.decoded(system), "-o", path)
        return path

    def raw(self, system: str) -> Path:
        """Return a recording of the bytes of a device, or of camera frames, with artifacts."""
        if system == "dots":
            return self.decoded(system)
        path = self.folder / f"{system}-raw.mcap"
        if not path.exists():
            write_raw(self.decoded(system), self.artifacts(system), path, DEVICES[system])
        return path

    def _polaris(self, path: Path) -> None:
        tags = Tags(codec="polaris-released", site={262_143: PlanarPose(0.0, 0.0, 0.0)})
        options = polaris.SimulationOptions(route=(262_143,), rest_s=0.5, odometry=True)
        run = polaris.simulate(tags, options)
        assert run.odometry is not None
        field_samples.write_magnetometers(
            path, [run.samples], tags=tags, truth=(run.truth,), odometry=(run.odometry,)
        )

    def _landmarks(self, path: Path) -> None:
        floor = design_map(DesignOptions(rows=2, columns=2))
        options = landmarks.SimulationOptions(
            strategy="path", cells=((0, 0), (0, 1)), stop_s=0.1, rest_s=0.5
        )
        run = landmarks.simulate(floor, options)
        field_samples.write_halls(
            path, run.samples, floor=floor, odometry=run.odometry, truth=run.truth
        )

    def _lighthouse(self, path: Path) -> None:
        receiver = self.folder / "receiver.toml"
        receiver.write_text(RECEIVER)
        locatk("simulate", "lighthouse", "--duration", 4, "--receiver", receiver, "-o", path)

    def _deck(self, path: Path) -> None:
        locatk("simulate", "lighthouse", "--duration", 4, "--3d", "--receiver", "deck", "-o", path)

    def _dots(self, path: Path) -> None:
        locatk("simulate", "dots", "--frames", 12, "-o", path)


def write_raw(session_path: Path, artifacts: Path, path: Path, device: str) -> None:
    """Write what a device sends of a session as `locatk capture` would record it."""
    session, attached = Session.open(session_path), Session.open(artifacts)
    with SessionWriter(path, system="") as writer:
        writer.metadata(CAPTURE_RECORD, {"device": device})
        for each in attached.attachments():
            content = attached.attachment(each.name)
            assert content is not None
            writer.attach(each.name, content, each.media_type)
        total = 0
        for time_ns, data in select_source(session, device).packets():
            chunk = SerialChunk(port="p", byte_offset=total, data=data, opened=not total)
            chunk.timestamp.FromNanoseconds(time_ns)
            writer.write("/serial/robot", chunk, time_ns)
            total += len(data)


def locatk(*arguments: object) -> None:
    """Run a command that must succeed."""
    from locatk.cli.app import app

    result = CliRunner().invoke(app, [str(each) for each in arguments], prog_name="locatk")
    assert result.exit_code == 0, result.output
