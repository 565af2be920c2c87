"""Sessions of ``locatk demo``: one per system, with truth, and the sheet to print."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from locatk.core.trajectory import Trajectory

SPEED_MPS = 0.1
"""Speed of the robot over the tags [m/s], which the published algorithm requires."""

PRINTED = {
    "dots": "dots-sheet.pdf",
    "polaris": "polaris-tags.pdf",
    "landmarks": "landmarks-pack.pdf",
}
"""Name of the file to print, if the system has one."""

Sheet = Callable[[], bytes]
"""Draws what is printed for a session, as PDF."""

Maker = Callable[[Path, int, bool], "tuple[tuple[Trajectory, ...], Sheet | None]"]
"""Function of folder, seed and overwrite that writes `<system>.mcap`; returns truth and sheet."""


def lighthouse(
    folder: Path, seed: int, overwrite: bool
) -> tuple[tuple[Trajectory, ...], Sheet | None]:
    """Simulate two robots under two stations."""
    from locatk.core.lighthouse.simulation import SimulationOptions, simulate
    from locatk.formats.sessions import observations

    simulated = simulate(
        SimulationOptions(robots=2, stations=2, planar=True, duration_s=60.0, seed=seed)
    )
    observations.write_session(
        folder / "lighthouse.mcap",
        system="lighthouse",
        sweeps=simulated.sweeps,
        scene=simulated.scene,
        truth=simulated.truth,
        overwrite=overwrite,
    )
    return simulated.truth, None


def dots(folder: Path, seed: int, overwrite: bool) -> tuple[tuple[Trajectory, ...], Sheet | None]:
    """Simulate a camera over a sheet."""
    from math import radians

    from locatk.core.dots.simulation import session as simulate
    from locatk.formats.sessions import frames

    options = simulate.SimulationOptions(
        frames=100,
        rate_hz=25.0,
        speed_mps=0.25,
        tilt_rad=radians(3),
        missing=0.02,
        dust=0.01,
        jitter_m=10e-6,
        noise=6.0,
        vignette=0.3,
        seed=seed,
    )
    simulated = simulate.simulate(None, options)
    frames.write_session(
        folder / "dots.mcap",
        [simulated.frames],
        simulated.manifest,
        camera=simulated.camera,
        truth=(simulated.truth,),
        overwrite=overwrite,
    )

    def draw() -> bytes:
        from locatk.formats.printing import pattern

        return pattern.render(simulated.manifest)

    return (simulated.truth,), draw


def polaris(
    folder: Path, seed: int, overwrite: bool
) -> tuple[tuple[Trajectory, ...], Sheet | None]:
    """Simulate a magnetometer array over three tags."""
    from math import radians

    from locatk.core.polaris.simulation import session as simulate
    from locatk.core.polaris.tag import PlanarPose, Tags
    from locatk.formats.sessions import field_samples

    ids = (262_143, 77, 123_456)
    tags = Tags(
        codec="polaris-released",
        site={
            number: PlanarPose(0.5 * k, 0.02 * k, radians(heading))
            for k, (number, heading) in enumerate(zip(ids, (0.0, 90.0, 200.0), strict=True))
        },
    )
    simulated = simulate.simulate(
        tags,
        simulate.SimulationOptions(
            route=ids,
            speed_mps=SPEED_MPS,
            build_angle_rad=radians(3),
            build_place_m=0.2e-3,
            build_strength=0.03,
            debris=3,
            odometry=True,
            seed=seed,
        ),
    )
    field_samples.write_magnetometers(
        folder / "polaris.mcap",
        [simulated.samples],
        tags=tags,
        truth=(simulated.truth,),
        odometry=() if simulated.odometry is None else (simulated.odometry,),
        overwrite=overwrite,
    )

    def draw() -> bytes:
        from locatk.core.polaris.codec import layout_of
        from locatk.core.polaris.drawing.cards import draw_tag_cards
        from locatk.formats.printing.drawings import render_pages

        layouts = [(number, layout_of(tags, number)) for number in ids]
        drawn = draw_tag_cards(tags, layouts, (210.0, 297.0))
        return render_pages(drawn.pages, "locatk demo")

    return (simulated.truth,), draw


def landmarks(
    folder: Path, seed: int, overwrite: bool
) -> tuple[tuple[Trajectory, ...], Sheet | None]:
    """Simulate a robot over a floor."""
    from locatk.core.landmarks.design.generation import DesignOptions, design_map
    from locatk.core.landmarks.simulation import session as simulate
    from locatk.formats.sessions import field_samples

    floor = design_map(DesignOptions(rows=6, columns=8, seed=seed))
    options = simulate.SimulationOptions(
        start=(0.3, 0.3, 0.4),
        landmarks=9,
        spins=9,
        faults=simulate.Faults(missing=(((2, 2), 1),)),
        seed=seed,
    )
    simulated = simulate.simulate(floor, options)
    field_samples.write_halls(
        folder / "landmarks.mcap",
        simulated.samples,
        floor=floor,
        truth=simulated.truth,
        odometry=simulated.odometry,
        overwrite=overwrite,
    )

    def draw() -> bytes:
        from locatk.core.landmarks.drawing.pack import draw_installation_pack
        from locatk.formats.printing.drawings import render_pages

        pack = draw_installation_pack(floor, (210.0, 297.0), paper_name="A4")
        return render_pages(pack.pages, "locatk demo")

    return simulated.truth, draw


MAKERS: dict[str, Maker] = {
    "lighthouse": lighthouse,
    "dots": dots,
    "polaris": polaris,
    "landmarks": landmarks,
}
