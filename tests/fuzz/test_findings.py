"""Input with which the fuzzer once broke a command."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from PIL import Image

from locatk.core.errors import FormatError, InputError
from locatk.core.evaluation.scoring import EvaluationOptions, evaluate
from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.trajectory import Trajectory
from locatk.formats import images
from locatk.formats.artifacts.kinds import POSITIVE, InvalidValueError, Number
from locatk.formats.capture.redecoding import decode
from locatk.formats.devices.lines.columns import without_overflow
from locatk.formats.importers.landmark_csv import read_landmarks
from locatk.formats.importers.poses.trajectory_csv import read_csv
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.writer import SessionWriter


def test_a_damaged_message_of_a_serial_line(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="") as writer:
        writer.write("/serial/robot", SerialChunk(data=b"1,2\n", port="/dev/ttyACM0"), 10**18)
    out = io.BytesIO()
    again = Writer(out, compression=CompressionType.NONE)
    again.start("", "test")
    for schema, _, message in make_reader(io.BytesIO(path.read_bytes())).iter_messages():
        assert schema is not None
        number = again.register_schema(schema.name, schema.encoding, schema.data)
        channel = again.register_channel("/serial/robot", "protobuf", number)
        data = message.data.replace(b"/dev/ttyACM0", b"/dev/\xff\xfeACM0")  # not UTF-8
        again.add_message(channel, message.log_time, data, message.log_time)
    again.finish()
    path.write_bytes(out.getvalue())
    with pytest.raises(FormatError, match="a message is damaged"):
        decode(path, tmp_path / "out.mcap", device="lines")
    assert not (tmp_path / "out.mcap").exists()


def test_positions_whose_squares_overflow_are_not_scored() -> None:
    position = np.random.default_rng(0).normal(size=(20, 3))
    position[3, 0] = -1e308
    time_ns = 10**18 + 100_000_000 * np.arange(20)
    track = Trajectory.from_positions("a", "floor", time_ns, position)
    with pytest.raises(InputError, match="beyond 1e\\+100 m"):
        evaluate([(track, track)], EvaluationOptions(align="sim3"))


def test_sigmas_and_quaternions_whose_squares_overflow(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    head = "time_s,device,x_m,y_m,z_m,qx,qy,qz,qw,sigma_x_m,sigma_y_m,sigma_z_m,sigma_heading_rad"
    for cells, words in (
        ("0,0,0,1,1e200,1,1,1", r"1e\+100 or less"),
        ("0,0,1e308,1,1,1,1,1", "a quaternion of length inf"),
    ):
        path.write_text(f"{head}\n1,a,0,0,0,{cells}\n")
        with pytest.raises(InputError, match=words):
            read_csv(path)


def test_odometry_and_waypoints_beyond_reason(tmp_path: Path) -> None:
    rows = [f"{0.02 * k},{0.01 * k},0,0,0.1,0.1,0.1,0.1" for k in range(60)]
    rows[20] = rows[20].replace(",0,0,0.1", ",-1e308,0,0.1")
    path = tmp_path / "run.csv"
    head = "t_s,x_m,y_m,heading_rad,front_mt,left_mt,rear_mt,right_mt"
    path.write_text("\n".join([head, *rows]))
    with pytest.raises(InputError, match=r"a pose of odometry beyond 1e\+09") as error:
        read_landmarks(path, sensors=HallSensors())
    assert error.value.where == 22
    with pytest.raises(InputError, match="waypoints"):
        SimulationOptions(strategy="path", waypoints=((0.0, 0.0), (1e305, 0.0)))


def test_numbers_of_artifacts_have_a_limit() -> None:
    assert Number().parse(-1e12) == -1e12
    with pytest.raises(InvalidValueError, match=r"at most 1e\+12 in magnitude"):
        Number().parse(-1e308)
    assert POSITIVE.parse(1e-12) == 1e-12
    with pytest.raises(InvalidValueError, match="exceeds 0 by 1e-12"):
        POSITIVE.parse(1e-300)


def test_values_beyond_float32_are_missing() -> None:
    values = without_overflow(np.array([1e-6, -1e308, np.inf, np.nan, 3e38]))
    assert np.array_equal(np.isnan(values), [False, True, True, True, False])


def test_a_tiff_whose_second_picture_has_no_width() -> None:
    whole = io.BytesIO()
    picture = Image.new("L", (20, 20))
    picture.save(whole, "TIFF", save_all=True, append_images=[picture])
    data = bytearray(whole.getvalue())
    width = data.rindex((256).to_bytes(2, "little") + b"\x04\0")  # tag and type
    data[width : width + 2] = (9999).to_bytes(2, "little")
    with pytest.raises(InputError, match="the image is damaged"):
        images.decode(bytes(data))
