"""docs/firmware: the header and the sketches, compiled and run here, and the page."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.formats.devices.interface import Options, Stream, Ticks
from locatk.formats.devices.locatk_frames import payloads
from locatk.formats.devices.locatk_frames.decoder import FrameDecoder
from locatk.formats.devices.locatk_frames.framing import checksum
from locatk.formats.devices.locatk_frames.payloads import FrameWriter, Type

STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-O1")

MAGNETOMETER_PINS = (2, 3, 4, 5, 7, 9, 10, 11, 15)
"""As the sketch has them; the stand-in for the sensor on pin 5 is not there."""


@pytest.fixture(scope="module")
def firmware(root: Path) -> Path:
    return root / "docs" / "firmware"


@pytest.fixture(scope="module")
def host(root: Path) -> Path:
    """What stands in for a board."""
    return root / "tests" / "data" / "firmware"


def compiled(compiler: str, output: Path, *arguments: object) -> Path:
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler} to compile firmware with")
    command = [compiler, *STRICT, *map(str, arguments), "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return output


def decoded(wire: bytes, piece: int) -> tuple[dict[Stream, Any], FrameDecoder]:
    """Columns of each stream, with its stamps, from pieces of this many bytes."""
    decoder = FrameDecoder(Options())
    found: dict[Stream, dict[str, list[Any]]] = {}
    for start in range(0, len(wire), piece):
        for batch in decoder.feed(wire[start : start + piece]):
            columns = {**batch.columns, "end": batch.end, "tick": batch.tick}
            columns["sequence"] = batch.sequence
            columns.setdefault("temperature_celsius", np.full(len(batch), np.nan))
            into = found.setdefault(batch.stream, {})
            for name, column in columns.items():
                into.setdefault(name, []).append(column)
    decoder.finish()
    joined = {
        stream: {name: np.concatenate(column) for name, column in columns.items()}
        for stream, columns in found.items()
    }
    return joined, decoder


def number(text: str) -> float:
    """A float32 of which the bits are told."""
    return float(np.array(int(text, 16), np.uint32).view(np.float32))


def said(kind: str, words: list[str]) -> dict[str, Any]:
    """Values of a record, from what frames.c printed of it."""
    if kind == "log":
        text = bytes.fromhex(words[1][1:]).decode()
        return {"level": int(words[0]), "text": text, "temperature_celsius": np.nan}
    if kind == "captures":
        names = ("sensor", "polynomial", "bit_offset", "bits")
        return {**dict(zip(names, map(int, words), strict=True)), "temperature_celsius": np.nan}
    if kind == "lighthouse":
        names = ("sensor", "channel", "polynomial", "sweep", "count")
        values = dict(zip(names, map(int, words), strict=True))
        return {**values, "count": values["count"] / 256, "temperature_celsius": np.nan}
    warmth = number(words.pop()[1:]) if words[-1][0] == "w" else np.nan
    if words[0][0] == "s":
        scale = number(words.pop(0)[1:])
        values = [np.nan if word == "-32768" else int(word) * scale for word in words]
    else:
        values = [number(word) for word in words]
    if kind == "odometry":
        names = ("x_m", "y_m", "heading_rad")
        return {**dict(zip(names, values, strict=True)), "temperature_celsius": np.nan}
    return {"b_tesla": np.array(values) * 1e-6, "temperature_celsius": warmth}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("compiler", "standard"), [("gcc", ("-std=c99",)), ("g++", ("-x", "c++", "-std=c++11"))]
)
def test_the_header_says_what_the_decoder_reads(
    firmware: Path, host: Path, tmp_path: Path, compiler: str, standard: tuple[str, ...]
) -> None:
    program = compiled(compiler, tmp_path / "frames", *standard, f"-I{firmware}", host / "frames.c")
    wire = tmp_path / "wire"
    done = subprocess.run([program, wire], capture_output=True, text=True, timeout=60, check=True)
    *lines, last = done.stdout.splitlines()
    sent, frames, lost = map(int, last.split()[1:])
    expected: dict[Stream, list[dict[str, Any]]] = {}
    for line in lines:
        kind, node, sensors, hz, end, sequence, tick, *words = line.split()
        stream = Stream(kind, node.strip("0"), int(sensors), ticks=Ticks(int(hz), 32))
        stamps = {"end": int(end), "sequence": int(sequence), "tick": int(tick)}
        expected.setdefault(stream, []).append({**stamps, **said(kind, words)})
    for piece in (1 << 20, 4099):
        found, decoder = decoded(wire.read_bytes(), piece)
        counts = decoder.counts
        assert (counts.bytes, counts.frames, counts.lost) == (sent, frames, lost)
        assert (counts.bad, counts.skipped, counts.unknown) == (0, 0, 0)
        assert decoder.remarks == []
        for stream, columns in found.items():
            if stream.kind == "log":  # each HELLO stands there, too, if it told anything
                kept = np.array(["hello from test µ" not in text for text in columns["text"]])
                columns.update({name: column[kept] for name, column in columns.items()})
        assert {stream for stream in found if len(found[stream]["end"])} == set(expected)
        for stream, records in expected.items():
            for name, column in found[stream].items():
                told = [record[name] for record in records]
                np.testing.assert_array_equal(column, np.array(told, column.dtype), f"{stream}")
    assert frames > 2000
    assert lost > 50  # frames for which a writer had no room
    assert {stream.kind for stream in expected} == {
        "log", "magnetometers", "halls", "odometry", "lighthouse", "captures",
    }  # fmt: skip


@pytest.mark.slow
def test_there_is_room_for_what_was_asked(firmware: Path, tmp_path: Path) -> None:
    source = tmp_path / "room.c"
    source.write_text("""
        #include "locatk_frame.h"
        static uint8_t memory[5000];
        int main(void)
        {
            size_t payload, size, n;
            for (payload = 0; payload <= LOCATK_LONGEST_PAYLOAD + 2; payload++) {
                locatk_writer w;
                size = LOCATK_MEMORY(payload);
                memory[size] = 77;
                locatk_init(&w, memory, size, 1);
                locatk_begin(&w, LOCATK_TEXT, 0x01010101);
                for (n = 0; n < payload; n++) locatk_put_u8(&w, 'x');
                if (!locatk_end(&w) != (payload > LOCATK_LONGEST_PAYLOAD)) return 1;
                if (memory[size] != 77) return 2;
                locatk_init(&w, memory, payload < 18 ? payload : 0, 1);
                if (locatk_hello(&w, 0, 1, "")) return 3;
            }
            return 0;
        }
    """)
    program = compiled("gcc", tmp_path / "room", "-std=c99", f"-I{firmware}", source)
    assert subprocess.run([program], timeout=60).returncode == 0


def run_sketch(firmware: Path, host: Path, tmp_path: Path, name: str, seconds: int) -> Any:
    sketch = firmware / name / f"{name}.ino"
    program = compiled(
        "g++",
        tmp_path / name,
        "-std=c++11",
        f'-DSKETCH="{sketch}"',
        f"-I{firmware}",
        f"-I{host}",
        host / "run_sketch.cpp",
    )
    done = subprocess.run([program, str(seconds)], capture_output=True, timeout=60, check=True)
    found, decoder = decoded(done.stdout, 4096)
    counts = decoder.counts
    assert (counts.bad, counts.lost, counts.skipped, counts.unknown) == (0, 0, 0, 0)
    assert decoder.remarks == []
    # HELLO: number 0 first, then each second.
    assert done.stdout.count(name.encode()) == seconds + 1
    (log,) = (columns for stream, columns in found.items() if stream.kind == "log")
    assert log["text"][0] == f"hello from {name} 1.0, 1000000 ticks/s"
    assert log["sequence"][0] == 0
    return found, log


@pytest.mark.slow
def test_the_sketch_of_magnetometers(firmware: Path, host: Path, tmp_path: Path) -> None:
    found, log = run_sketch(firmware, host, tmp_path, "locatk_magnetometers", 4)
    bar = found[Stream("magnetometers", sensors=9, ticks=Ticks(1_000_000, 32))]
    assert log["text"].tolist()[1:] == ["no sensor 003"]
    # Each sample when it was due, to the time that reading nine sensors takes.
    steps = np.diff(bar["tick"]) % 2**32
    assert abs(len(bar["tick"]) - 4 * 50) <= 1
    assert np.abs(steps - 20_000).max() < 800
    assert (np.diff(bar["tick"]) < 0).sum() == 1  # micros() starts again
    pins = np.array(MAGNETOMETER_PINS)
    field = np.column_stack([pins + 0.25, -pins, 100 * pins]) * 1e-6
    field[MAGNETOMETER_PINS.index(5)] = np.nan
    expected = np.broadcast_to(field.ravel(), bar["b_tesla"].shape)
    np.testing.assert_allclose(bar["b_tesla"], expected, rtol=1e-7)


@pytest.mark.slow
def test_the_sketch_of_hall_sensors(firmware: Path, host: Path, tmp_path: Path) -> None:
    found, _ = run_sketch(firmware, host, tmp_path, "locatk_halls", 4)
    halls = found[Stream("halls", sensors=4, ticks=Ticks(1_000_000, 32))]
    assert abs(len(halls["tick"]) - 4 * 250) <= 5
    assert set((np.diff(halls["tick"]) % 2**32).tolist()) == {4000}
    # analogRead gives 500 and the number of the pin, A0 is 14.
    field = (500 + np.arange(14, 18) - 512) * 97.65625e-6
    expected = np.broadcast_to(field, halls["b_tesla"].shape)
    np.testing.assert_allclose(halls["b_tesla"], expected, rtol=1e-7)


def test_the_page_shows_right_bytes(firmware: Path) -> None:
    page = (firmware / "README.md").read_text(encoding="utf-8")
    shown = re.findall(r"^content (.*)\ncrc +(.*)\nwire +(.*)$", page, re.MULTILINE)
    writer = FrameWriter()
    frames = [
        writer.frame(Type.HELLO, 1000, payloads.hello(1_000_000, "demo 1.0")),
        writer.frame(
            Type.HALLS, 4096, payloads.series([[100, -200], [101, -201]], 4000, scale=97.65625)
        ),
    ]
    assert len(shown) == len(frames)
    for (content, crc, wire), frame in zip(shown, frames, strict=True):
        assert bytes.fromhex(wire) == frame
        assert bytes.fromhex(crc) == checksum(bytes.fromhex(content))
    _, decoder = decoded(b"".join(bytes.fromhex(wire) for *_, wire in shown), 1)
    assert decoder.counts.frames == 2


def test_page_and_header_name_the_same_types(firmware: Path) -> None:
    page = (firmware / "README.md").read_text(encoding="utf-8")
    header = (firmware / "locatk_frame.h").read_text(encoding="utf-8")
    types = {type.name: type.value for type in Type}
    on_page = {name: int(n) for name, n in re.findall(r"([A-Z_]+), type (\d+)", page)}
    assert on_page == types
    defined = {name: int(n) for name, n in re.findall(r"#define LOCATK_([A-Z_]+) (\d+)", header)}
    assert types.items() <= defined.items()
    assert defined["VERSION"] == payloads.PROTOCOL_VERSION
    assert (defined["COUNTS"], defined["TEMPERATURE"]) == (
        payloads.HAS_COUNTS,
        payloads.HAS_TEMPERATURE,
    )
