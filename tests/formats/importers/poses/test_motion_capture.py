"""Exports of motion capture systems and EuRoC, written here by hand from known poses."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from locatk.core.errors import LocatkError
from locatk.formats.importers.poses import trajectories

N = 40
TIME_S = 0.01 * np.arange(N)
POSITION = np.stack([np.cos(TIME_S), 0.5 * np.sin(TIME_S), 0.3 + 0.1 * TIME_S], 1)
ROTATION = Rotation.from_rotvec(np.stack([0.3 * TIME_S, 0.2 - TIME_S, 1.0 + 2.0 * TIME_S], 1))
LOST = 7
"""Row in which the first body is not tracked."""


def motive(second: bool = True) -> str:
    """Return two rigid bodies of Motive: metres, y up, markers between them."""
    quaternion, position = ROTATION.as_quat(), POSITION
    # Motive's x, y, z are forward, up, right: z up is its y, y left its -z.
    axes = np.column_stack([position[:, 0], position[:, 2], -position[:, 1]])
    turns = np.column_stack(
        [quaternion[:, 0], quaternion[:, 2], -quaternion[:, 1], quaternion[:, 3]]
    )
    head = [
        "Format Version,1.23,Take Name,Take 1,Capture Frame Rate,100.0,Capture Start Time,"
        "2024-02-29 04.01.27.412 PM,Total Frames in Take,40,Rotation Type,Quaternion,"
        "Length Units,Meters,Coordinate Space,Global",
        "",
        ",Type" + ",Rigid Body" * 8 + ",Rigid Body Marker" * 3 + ",Rigid Body" * 8,
        ",Name" + ",robot 1" * 8 + ",robot 1:Marker1" * 3 + ",robot 2" * 8,
        ",ID" + ",1" * 8 + ",A" * 3 + ",2" * 8,
        ",," + "Rotation," * 4 + "Position," * 3 + "Mean Marker Error," + "Position," * 3
        + "Rotation," * 4 + "Position," * 3 + "Mean Marker Error",
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z,X,Y,Z,W,X,Y,Z,",
    ]  # fmt: skip
    for k in range(N):
        body = [*turns[k], *axes[k], 1e-4]
        first = [""] * 8 if k == LOST else [f"{value:.9f}" for value in body]
        other = [f"{value:.9f}" for value in body]
        head.append(",".join([str(k), f"{TIME_S[k]:.6f}", *first, *["0.1"] * 3, *other]))
    return "\r\n".join(head) + "\r\n"


def vicon(unit: str = "rad", quaternion: bool = False) -> str:
    scale = 180 / math.pi if unit == "deg" else 1.0
    turns = ROTATION.as_quat() if quaternion else scale * ROTATION.as_rotvec()
    names = ["RX", "RY", "RZ", *(["RW"] if quaternion else []), "TX", "TY", "TZ"]
    lines = [
        "Objects",
        "100",
        ",,robot 1" + "," * (len(names) - 1),
        ",".join(["Frame", "Sub Frame", *names]),
        ",".join(["", "", *[unit] * (len(names) - 3), "mm", "mm", "mm"]),
    ]
    for k in range(N):
        values = [*turns[k], *(1e3 * POSITION[k])]
        cells = [""] * len(values) if k == LOST else [f"{value:.9g}" for value in values]
        lines.append(",".join([str(k + 1), "0", *cells]))
    return "\n".join(lines) + "\n"


def qualisys() -> str:
    matrix = ROTATION.as_matrix()
    lines = ["NO_OF_FRAMES\t40", "NO_OF_CAMERAS\t8", "FREQUENCY\t100", "DESCRIPTION\t--",
             "TIME_STAMP\t2024-02-29, 16:01:27.412", "DATA_INCLUDED\t6D", "NO_OF_BODIES\t1",
             "BODY_NAMES\trobot 1",
             "\t".join(["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual",
                        *(f"Rot[{k}]" for k in range(9))])]  # fmt: skip
    for k in range(N):
        columns = [matrix[k][row][column] for column in range(3) for row in range(3)]
        values = [*(1e3 * POSITION[k]), 1.0, 2.0, 3.0, 0.5, *columns]
        if k == LOST:
            values = [0.0] * 6 + [-1.0] + [0.0] * 9
        lines.append("\t".join(f"{value:.9f}" for value in values))
    return "\n".join(lines) + "\n"


def euroc() -> str:
    quaternion = ROTATION.as_quat()
    lines = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
             "q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]"]  # fmt: skip
    for k in range(N):
        if k != LOST:
            x, y, z, w = quaternion[k]
            values = ",".join(f"{value:.12f}" for value in (*POSITION[k], w, x, y, z, 0.1))
            lines.append(f"{1_700_000_000_000_000_000 + round(1e9 * TIME_S[k])},{values}")
    return "\n".join(lines) + "\n"


FILES: dict[str, tuple[str, str]] = {
    "motive": ("motive", motive()),
    "vicon, rotation vectors": ("vicon", vicon()),
    "vicon, degrees": ("vicon", vicon("deg")),
    "vicon, quaternions": ("vicon", vicon(quaternion=True)),
    "qualisys": ("qualisys", qualisys()),
    "euroc": ("euroc", euroc()),
}


@pytest.mark.parametrize("name", FILES)
def test_known_poses_come_back(name: str, tmp_path: Path) -> None:
    kind, text = FILES[name]
    path = tmp_path / "robot 1.csv"
    path.write_text(text, newline="")
    read = trajectories.open_file(path, role="truth")
    assert read.kind == kind
    track = read.trajectories[0]
    assert track.device == "robot 1"
    tracked = np.delete(np.arange(N), LOST)
    np.testing.assert_allclose(
        1e-9 * (track.time_ns - track.time_ns[0]), TIME_S[tracked], atol=1e-9
    )
    np.testing.assert_allclose(track.position, POSITION[tracked], atol=2e-8)
    error = Rotation.from_quat(track.quaternion) * ROTATION[tracked].inv()
    assert error.magnitude().max() < 1e-7
    if kind == "motive":
        assert [len(each) for each in read.trajectories] == [N - 1, N]
        assert any("y axis is up" in note for note in read.notes)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (motive().replace("Quaternion", "XYZ"), "rotations as XYZ angles"),
        (motive().replace("Rigid Body", "Marker"), "no tracked rigid body"),
        (motive().replace("\r\nFrame,", "\r\nFrames,"), "an incomplete header"),
        (motive().replace("Meters", "Furlongs"), "an incomplete header"),
        (vicon().replace("\n100\n", "\n\n"), "an incomplete header"),
        (vicon().replace("mm", "ft"), "no position in a known unit"),
        (vicon()[:-4] + "ten\n", "'"),
        (qualisys().replace("FREQUENCY", "RATE"), "no 6DOF data"),
        (qualisys().replace("Rot[0]", "Rot0"), "no 6DOF data"),
        (euroc().replace(",0.1", ",0.1", 1).replace("1700000000100000000", "17000"), "ascend"),
        (euroc().splitlines()[0] + "\n", "no poses"),
        (motive()[:700], ""),
        (qualisys()[:300], ""),
    ],
)
def test_broken_exports_are_one_line(text: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "take.csv"
    path.write_text(text, newline="")
    with pytest.raises(LocatkError) as raised:
        trajectories.open_file(path, role="truth")
    assert problem in raised.value.message


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    start=st.floats(0, 1),
    length=st.integers(0, 400),
    inserted=st.text('0123456789.,\t\n-eE RXTFrame;"[]', max_size=8),
)
@example(start=0.0, length=0, inserted='"')
@example(start=0.108, length=71, inserted="1")  # A component of a quaternion is absent.
def test_damaged_exports_are_refused_or_read(
    name: str, start: float, length: int, inserted: str, tmp_path: Path
) -> None:
    text = FILES[name][1]
    at = round(start * len(text))
    path = tmp_path / "take.csv"
    path.write_text(text[:at] + inserted + text[at + length :], newline="")
    tracks = []
    with contextlib.suppress(LocatkError):
        tracks = trajectories.open_file(path, role="truth").trajectories
    for track in tracks:
        assert (np.diff(track.time_ns) > 0).all()
        assert np.isfinite(track.position).all()
        np.testing.assert_allclose(np.linalg.norm(track.quaternion, axis=1), 1.0, atol=1e-9)


@pytest.mark.slow
def test_errors_do_not_depend_on_the_format_of_the_truth(
    locatk: Callable[..., Any], tmp_path: Path
) -> None:
    run, solved = tmp_path / "run.mcap", tmp_path / "solved.mcap"
    simulation = ("simulate", "lighthouse", "--flight", "--receiver", "deck", "--duration", "8")
    assert locatk(*simulation, "-o", run).exit_code == 0
    assert locatk("solve", run, "-o", solved).exit_code == 0
    from locatk.formats.importers.poses.trajectories import read

    (truth,) = read(run, role="truth")
    quaternion = truth.quaternion
    take = ["Format Version,1.23,Capture Frame Rate,100,Rotation Type,Quaternion,Length Units,"
            "Millimeters,Coordinate Space,Global", ",Type" + ",Rigid Body" * 7,
            ",Name" + ",robot-1" * 7, ",," + "Rotation," * 4 + "Position,Position,Position",
            "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z"]  # fmt: skip
    for k, (x, y, z) in enumerate(1e3 * truth.position):
        qx, qy, qz, qw = quaternion[k]
        time_s = 1e-9 * (truth.time_ns[k] - truth.time_ns[0])
        take.append(f"{k},{time_s:.9f},{qx},{qz},{-qy},{qw},{x},{z},{-y}")
    mocap = tmp_path / "take.csv"
    mocap.write_text("\n".join(take))
    import locatk as door

    direct = door.evaluate(str(solved), str(run), align="se3").ape_translation
    offset_s = -1e-9 * float(truth.time_ns[0])
    other = door.evaluate(str(solved), str(mocap), align="se3", offset_s=offset_s).ape_translation
    assert direct is not None
    assert other is not None
    assert other.rmse == pytest.approx(direct.rmse, rel=1e-3)
    result = locatk("eval", solved, "--truth", mocap, "--align", "se3", "--offset", "auto")
    assert result.exit_code == 0, result.stderr
    assert "Motive's y axis is up" in result.stderr
