"""Fuzzing of every reader, through the commands that use it.

::

    python tests/fuzz/run.py --seconds 120 --seed 1      all targets in turn
    python tests/fuzz/run.py --target tables --cases 20
    python tests/fuzz/run.py --only tables:1:17 --keep DIR   one case again, with its files

Valid files are made by the simulators and writers of locatk, damaged (``mutations.py``) and given
to a command in a process of its own, with limits on memory and time. Whatever the damage, the
command must end with a status of 0 to 3; a failure is one line; JSON is strict; nothing is left
behind but the output. Each case depends on its target, the seed and its number only.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import os
import pkgutil
import re
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import mutations
import numpy as np
from mutations import Damage

MEMORY_BYTES = 1 << 30
"""Memory that a command may use beyond that of the imported program."""

CPU_S = 20
"""Processor time of a command. The undamaged inputs take less than 1 s."""

WALL_S = 120
"""Time after which a command counts as waiting forever."""

FILE_BYTES = 256 << 20
"""Size of the largest file that a command may write."""

Words = tuple[str, ...]


@dataclass(frozen=True)
class Target:
    """Files to damage, and the commands that read them.

    Attributes
    ----------
    files : tuple of str
        Names in the corpus; one of them is damaged.
    damages : tuple of callable
    commands : tuple of tuple of str
        ``{}`` stands for the damaged file; other files of the corpus are in the same folder.
    """

    files: Words
    damages: tuple[Damage, ...]
    commands: tuple[Words, ...]


@dataclass(frozen=True)
class Result:
    """End of a command: its status (negative: signal), and what it printed."""

    status: int
    stdout: str
    stderr: str
    seconds: float


# ---- running commands


def import_program() -> None:
    """Import all modules of locatk, so that the processes of the cases start at once."""
    warnings.filterwarnings("ignore", category=UserWarning)
    for layer in ("core", "formats", "cli"):
        package = importlib.import_module(f"locatk.{layer}")
        for module in pkgutil.walk_packages(package.__path__, f"locatk.{layer}."):
            if not module.name.endswith(("__main__", ".generate")):
                importlib.import_module(module.name)
    import cv2

    cv2.setNumThreads(1)


def run(words: Sequence[str], folder: Path) -> Result:
    """Run a command in ``folder`` in a process of its own, within the limits."""
    start = time.monotonic()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if child == 0:
            os._exit(_run_here(words, folder, out.fileno(), err.fileno()))
        status = _wait(child, start + WALL_S)
        out.seek(0)
        err.seek(0)
        stdout, stderr = (stream.read().decode("utf-8", "replace") for stream in (out, err))
    return Result(status, stdout, stderr, time.monotonic() - start)


def _wait(child: int, end_s: float) -> int:
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end_s:
            os.kill(child, signal.SIGKILL)
            end_s = float("inf")
        time.sleep(0.002)


def _run_here(words: Sequence[str], folder: Path, out: int, err: int) -> int:
    """Run a command in this process, and return its status."""
    from locatk.cli.app import app

    os.setsid()
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(out, 1)
    os.dup2(err, 2)
    sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), "utf-8", write_through=True)
    sys.stderr = io.TextIOWrapper(io.FileIO(2, "w", closefd=False), "utf-8", write_through=True)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    memory = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 1))
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.chdir(folder)
    try:
        app(list(words), prog_name="locatk")
    except SystemExit as end:
        sys.stdout.flush()
        return end.code if isinstance(end.code, int) else 1
    except BaseException as error:
        print(f"escaped: {type(error).__name__}: {error}", file=sys.stderr)
        return 99
    return 98


def complaint(words: Sequence[str], result: Result, left: Sequence[str]) -> str | None:
    """Return the reason for which the end of a command is wrong, or None."""
    if result.status < 0:
        return f"killed by {signal.Signals(-result.status).name} after {result.seconds:.0f} s"
    if result.status not in (0, 1, 2, 3):
        return f"exit status {result.status}"
    for sign in ("internal error", "Traceback", "not enough memory", "RuntimeWarning"):
        if sign in result.stderr:
            return sign
    if re.search(r"Warning: .*\n\s+\S", result.stderr) and ".py:" in result.stderr:
        return "a warning of Python"
    if (
        result.status in (1, 2)
        and sum(line.startswith("Error: ") for line in result.stderr.splitlines()) != 1
    ):
        return "a failure that is not one line"
    if re.search(
        r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]", result.stderr + result.stdout
    ):
        return "control characters"
    if "--json" in words and result.status in (0, 3):
        for line in result.stdout.splitlines():
            try:
                json.loads(line, parse_constant=_no_constant)
            except ValueError as error:
                return f"JSON: {error}"
        if not result.stdout.strip():
            return "no JSON"
    if left:
        return f"left behind: {', '.join(left)}"
    return None


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


# ---- the corpus


def build_corpus(folder: Path) -> None:
    """Write a small valid file of each kind."""
    (folder / "eight-sim.toml").write_text(
        'format = "locatk-simulation-polaris"\nformat_version = 1\n[sensors]\ncount = 8\n'
    )
    (folder / "route.csv").write_text("x_mm,y_mm\n0,0\n1500,0\n1500,900\n")
    (folder / "room.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="300mm" height="200mm" '
        'viewBox="0 0 300 200"><path d="M10 10 H290 V190 H10 Z"/></svg>'
    )
    made = (
        "tag design -o tag.toml",
        "map design 8x8 -o map.toml",
        "simulate lighthouse -o lighthouse.mcap --duration 4 --robots 2",
        "room design 3x2x2.5 --stations 2 --floor 100 --robots 3 -o room.toml",
        "site design tag.toml --route route.csv --spacing 900 -o site.toml",
        "simulate dots -o dots.mcap --frames 8",
        "simulate polaris tag.toml -o polaris.mcap --id 5 --seed 1",
        "simulate polaris tag.toml -o eight.mcap --config eight-sim.toml",
        "simulate landmarks map.toml -o landmarks.mcap --landmarks 4",
        *(f"solve {name}.mcap -o {name}-solved.mcap" for name in SYSTEMS),
        "solve lighthouse.mcap -o x.mcap --save-scene scene.toml --overwrite",
        *(f"export lighthouse-solved.mcap --format {form} -o robot-1{end} --device robot-1"
          for form, end in (("csv", ".csv"), ("tum", ".tum"), ("kitti", ".kitti"),
                            ("ros2", "-ros.mcap"))),
        "export lighthouse.mcap --format csv -o truth.csv",
        "map export map.toml -o map.csv",
        "map export map.toml -o map.json",
        "print testsheet -o test.pdf",
        "print pattern -o sheet.png --size 60x40mm --margin 3",
        "print pattern -o sheet2.pdf --size 60x40mm --margin 3",
        "export scene.toml --format crazyflie-config -o stations.yaml",
    )  # fmt: skip
    for line in made:
        result = run(line.split(), folder)
        if result.status not in (0, 3):
            raise SystemExit(f"locatk {line}: {result.status}, {result.stderr}")
    for name, words in (
        ("cameras", ["camera", "design", "--print-cameras"]),
        ("prices", ["advise", "--print-prices"]),
        ("task", ["advise", "--area", "1x1", "--accuracy", "30", "--print-task"]),
    ):
        (folder / f"{name}.toml").write_text(run(words, folder).stdout)
    for name in SYSTEMS:
        words = ["simulate", name, *(["map.toml"] if name == "landmarks" else []), "--print-config"]
        (folder / f"{name}-sim.toml").write_text(run(words, folder).stdout)
        _save_attachments(folder / f"{name}.mcap", folder)
    _write_tables(folder)
    _write_crazyflie_logs(folder)
    _write_images(folder)
    _write_streams(folder)
    _write_document(folder)


SYSTEMS = ("lighthouse", "dots", "polaris", "landmarks")

STREAMS = {
    "locatk": "landmarks",
    "polaris-array": "polaris",
    "magx-array": "eight",
    "lighthouse-deck": "lighthouse",
    "dotbot-gateway": "lighthouse",
    "lines": "landmarks",
}
"""Session whose data each device sends."""


def _save_attachments(session: Path, folder: Path) -> None:
    from mcap.reader import make_reader

    with open(session, "rb") as stream:
        for part in make_reader(stream).iter_attachments():
            path = folder / part.name
            if part.name.endswith(".toml") and "/" not in part.name and not path.exists():
                path.write_bytes(part.data)


def _write_tables(folder: Path) -> None:
    rng = np.random.default_rng(0)
    start = np.datetime64("2023-07-27T15:34:22.700963")
    times = [f"{start + np.timedelta64(100 * k, 'ms')}Z" for k in range(60)]
    counts = rng.integers(20_000, 100_000, (60, 4))
    pairs = list(zip(times, counts, strict=True))
    head = "idx,timestamp,source,LHA_count_1,LHA_count_2,LHB_count_1,LHB_count_2"
    rows = [f"{k},{t},R,{','.join(map(str, c))}" for k, (t, c) in enumerate(pairs)]
    (folder / "two.csv").write_text("\n".join([head, *rows, ""]))
    rows = [f"{k},{t},0.5,0.5,{c[0]},{c[1]}" for k, (t, c) in enumerate(pairs)]
    (folder / "one.csv").write_text("\n".join(["idx,timestamp,x,y,c0,c1", *rows, ""]))
    head = "timestamp," + ",".join(f"Sensor {k + 1}" for k in range(4))
    fields = rng.normal(0, 30, (80, 4, 3))
    rows = [f"{k}," + ",".join('"({:.2f}, {:.2f}, {:.2f})"'.format(*c) for c in row)
            for k, row in enumerate(fields)]  # fmt: skip
    (folder / "bar.csv").write_text("\n".join([head, *rows, ""]))
    head = "t_s,x_m,y_m,heading_rad,front_mt,left_mt,rear_mt,right_mt"
    rows = [f"{0.02 * k:.2f},{0.001 * k:.3f},0,0," + ",".join(f"{v:.3f}" for v in values)
            for k, values in enumerate(rng.normal(0, 0.3, (200, 4)))]  # fmt: skip
    (folder / "halls.csv").write_text("\n".join([head, *rows, ""]))
    records = [f"timestamp={t} level=info event=lh2 source=abcd poly={k % 2} lfsr_index={c[0]} "
               f"db_time={100_000 * k}" for k, (t, c) in enumerate(pairs)]  # fmt: skip
    (folder / "gateway.log").write_text("\n".join(records))
    (folder / "path.csv").write_text("x_mm,y_mm\n200,200\n600,200\n600,600\n")


def _write_crazyflie_logs(folder: Path) -> None:
    """Write a log of a micro SD card, of either version, and the CSV file of a log block."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    import crazyflie

    flight = crazyflie.Flight(seconds=2.0)
    for version in (1, 2):
        rng = np.random.default_rng(version)
        log = crazyflie.write_flight(flight, rng, version=version, angles=True, estimator=True)
        (folder / f"log0{version}").write_bytes(log.data())
    head = "Timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z,acc.x,acc.y,acc.z"
    angles = ",".join(f"lighthouse.rawAngle{k}{axis}lh2" for k in (0, 1) for axis in "xy")
    values = np.random.default_rng(3).normal(0, 0.3, (200, 10))
    rows = [f"{12_000 + 10 * k}," + ",".join(f"{v:.4f}" for v in row)
            for k, row in enumerate(values)]  # fmt: skip
    (folder / "block.csv").write_text("\n".join([f"{head},{angles}", *rows, ""]))


def _write_images(folder: Path) -> None:
    import cv2

    page = cv2.imread(str(folder / "sheet.png"), cv2.IMREAD_GRAYSCALE)
    if page is None:
        page = cv2.imread(str(next(folder.glob("sheet*.png"))), cv2.IMREAD_GRAYSCALE)
    frame = np.ascontiguousarray(page[100:220, 100:260])
    pdfium = importlib.import_module("pypdfium2")
    scan = pdfium.PdfDocument(str(folder / "test.pdf"))[0].render(scale=150 / 72).to_numpy()
    cv2.imwrite(str(folder / "scan.png"), scan)
    for ending in ("png", "jpg", "bmp", "tif", "pgm", "webp"):
        cv2.imwrite(str(folder / f"frame.{ending}"), frame)
    writer = cv2.VideoWriter(
        str(folder / "frames.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20, (160, 120)
    )
    for _ in range(3):
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()


def _write_streams(folder: Path) -> None:
    """Write what each device sends, as bytes and as a recording of these bytes."""
    from locatk.formats.emulation.sources import select_source
    from locatk.formats.schemas.serial_pb2 import SerialChunk
    from locatk.formats.sessions.reader import Session
    from locatk.formats.sessions.writer import SessionWriter

    for device, system in STREAMS.items():
        source = select_source(Session.open(folder / f"{system}.mcap"), device)
        with SessionWriter(folder / f"{device}-raw.mcap", system="") as writer:
            total = 0
            for time_ns, data in source.packets():
                chunk = SerialChunk(port="/dev/ttyACM0", byte_offset=total, data=data)
                chunk.timestamp.FromNanoseconds(time_ns)
                writer.write("/serial/robot", chunk, time_ns)
                total += len(data)
                if total > 20_000:
                    break


def _write_document(folder: Path) -> None:
    from reportlab.pdfgen.canvas import Canvas

    canvas = Canvas(str(folder / "plan.pdf"), pagesize=(170, 120))
    canvas.setFillColorCMYK(0, 0, 0, 1)
    canvas.rect(20, 20, 60, 40, fill=1)
    canvas.setFillColorRGB(0.9, 0.2, 0.1)
    canvas.drawString(30, 90, "Hall 3")
    canvas.drawImage(str(folder / "frame.png"), 100, 20, 50, 40)
    canvas.showPage()
    canvas.save()


# ---- targets

PRINT = ("print", "pattern", "--overlay", "{}", "-o", "out.pdf")
MCAP = (mutations.damage_mcap, mutations.damage_mcap, mutations.damage_mcap, mutations.damage_bytes)

TARGETS = {
    "sessions": Target(
        tuple(f"{name}.mcap" for name in SYSTEMS),
        MCAP,
        (
            ("info", "{}", "--json"),
            ("info", "{}"),
            ("solve", "{}", "-o", "out.mcap", "--json"),
            ("solve", "{}", "-o", "out.mcap"),
            ("solve", "{}", "-o", "out.mcap", "--method", "paper"),
            ("export", "{}", "--format", "csv", "-o", "out.csv"),
            ("eval", "lighthouse-solved.mcap", "--truth", "{}", "--json"),
        ),
    ),
    "calibrate": Target(
        tuple(f"{name}.mcap" for name in SYSTEMS),
        MCAP,
        (
            ("calibrate", "scene", "{}", "-o", "out.toml", "--json"),
            ("calibrate", "camera", "{}", "-o", "out.toml", "--json"),
            ("calibrate", "tag", "{}", "eight.mcap", "-o", "out.toml", "--json"),
            ("calibrate", "map", "{}", "-o", "out.toml", "--json"),
        ),
    ),
    "solutions": Target(
        tuple(f"{name}-solved.mcap" for name in SYSTEMS),
        MCAP,
        (
            ("info", "{}", "--json"),
            ("eval", "{}", "--truth", "lighthouse.mcap", "--json"),
            ("eval", "{}", "--truth", "{}", "--full"),
            *(
                ("export", "{}", "--format", form, "-o", f"out{ending}", "--json")
                for form, ending in (
                    *(("csv", ".csv"), ("tum", ""), ("kitti", ""), ("parquet", ".parquet")),
                    *(("ros2", ".mcap"), ("crazyflie-config", ".yaml"),
                      ("dotbot-calibration", ".out")),
                )
            ),
            ("report", "{}", "-o", "out.html"),
        ),
    ),
    "recover": Target(
        (*(f"{name}.mcap" for name in SYSTEMS), "lighthouse-solved.mcap", "lines-raw.mcap"),
        (mutations.damage_bytes,),
        (("recover", "{}", "-o", "out.mcap", "--json"), ("recover", "{}", "-o", "out.mcap")),
    ),
    "devices": Target(
        tuple(f"{name}-raw.mcap" for name in STREAMS),
        (mutations.damage_mcap, mutations.damage_stream, mutations.damage_stream),
        (
            ("decode", "{}", "-o", "out.mcap", "--json"),
            *(("decode", "{}", "-o", "out.mcap", "--device", name) for name in (*STREAMS, "auto")),
            ("info", "{}", "--json"),
        ),
    ),
    "tables": Target(
        ("two.csv", "one.csv", "bar.csv", "halls.csv", "gateway.log"),
        (mutations.damage_text,),
        (
            ("import", "dotbot-lh2", "{}", "-o", "out.mcap", "--json"),
            ("import", "polaris-csv", "{}", "-o", "out.mcap", "--rate", "40", "--spacing", "20"),
            ("import", "landmark-csv", "{}", "-o", "out.mcap", "--circle", "25", "--json"),
            ("import", "dotbot-log", "{}", "-o", "out.mcap"),
        ),
    ),
    "crazyflie-logs": Target(
        ("log01", "log02"),
        (mutations.damage_bytes,),
        (
            ("import", "crazyflie-usd", "{}", "-o", "out.mcap", "--json"),
            ("import", "crazyflie-usd", "{}", "--config", "stations.yaml", "-o", "out.mcap"),
        ),
    ),
    "crazyflie-tables": Target(
        ("block.csv",),
        (mutations.damage_text, mutations.damage_text, mutations.damage_bytes),
        (
            ("import", "crazyflie-csv", "{}", "-o", "out.mcap", "--json"),
            ("import", "crazyflie-csv", "{}", "--config", "stations.yaml", "-o", "out.mcap"),
        ),
    ),
    "trajectories": Target(
        ("robot-1.csv", "robot-1.tum", "robot-1.kitti", "truth.csv"),
        (mutations.damage_text,),
        (
            ("eval", "{}", "--truth", "lighthouse.mcap", "--json"),
            ("eval", "lighthouse-solved.mcap", "--truth", "{}", "--json"),
            ("eval", "{}", "--truth", "{}", "--align", "sim3", "--full"),
            ("eval", "truth.csv", "--truth", "{}", "--offset", "auto", "--json"),
        ),
    ),
    "artifacts": Target(
        ("tag.toml", "map.toml", "scene.toml", "sheet.toml", "camera.toml", "array.toml"),
        (mutations.damage_toml,),
        (
            ("info", "{}", "--json"),
            ("info", "{}"),
            *(
                ("solve", f"{name}.mcap", "--artifact", "{}", "-o", "out.mcap", "--json")
                for name in SYSTEMS
            ),
        ),
    ),
    "tags": Target(
        ("tag.toml",),
        (mutations.damage_toml,),
        (
            ("tag", "check", "{}", "--json"),
            ("tag", "encode", "5", "--tag", "{}", "--json"),
            ("simulate", "polaris", "{}", "-o", "out.mcap"),
            ("print", "tag", "{}", "--id", "5", "-o", "out.pdf"),
            ("solve", "polaris.mcap", "--tag", "{}", "-o", "out.mcap"),
        ),
    ),
    "maps": Target(
        ("map.toml",),
        (mutations.damage_toml,),
        (
            ("map", "check", "{}", "--json"),
            *(
                ("map", "export", "{}", "-o", f"out.{ending}")
                for ending in ("csv", "json", "svg", "dxf", "yaml")
            ),
            ("print", "landmarks", "{}", "-o", "out.pdf"),
            ("simulate", "landmarks", "{}", "-o", "out.mcap", "--landmarks", "2"),
        ),
    ),
    "rooms": Target(
        ("room.toml",),
        (mutations.damage_toml,),
        (
            ("room", "check", "{}", "--json"),
            ("room", "design", "{}", "--stations", "1", "-o", "out.toml", "--json"),
            ("simulate", "lighthouse", "--artifact", "{}", "-o", "out.mcap", "--duration", "2"),
            ("solve", "lighthouse.mcap", "--artifact", "{}", "-o", "out.mcap", "--json"),
        ),
    ),
    "floor-plans": Target(
        ("room.svg",),
        (mutations.damage_text, mutations.damage_bytes),
        (
            (
                *("room", "design", "{}", "--height", "2500", "--floor", "0"),
                *("--stations", "1", "-o", "out.toml", "--json"),
            ),
        ),
    ),
    "routes": Target(
        ("route.csv",),
        (mutations.damage_text,),
        (
            ("map", "check", "map.toml", "--route", "{}", "--json"),
            ("site", "check", "site.toml", "--route", "{}", "--json"),
            (
                *("site", "design", "tag.toml", "--route", "{}", "--accuracy", "30"),
                *("-o", "out.toml", "--json"),
            ),
        ),
    ),
    "plans": Target(
        ("cameras.toml", "prices.toml", "task.toml"),
        (mutations.damage_toml,),
        (
            ("camera", "design", "--cameras", "{}", "--frames", "0", "--json"),
            ("tag", "design", "--prices", "{}", "-o", "out.toml", "--json"),
            ("advise", "--task", "{}", "--json"),
        ),
    ),
    "foreign-maps": Target(
        ("map.csv", "map.json"),
        (mutations.damage_text, mutations.damage_text, mutations.damage_bytes),
        (("map", "import", "{}", "-o", "out.toml", "--json"),),
    ),
    "settings": Target(
        tuple(f"{name}-sim.toml" for name in SYSTEMS),
        (mutations.damage_toml,),
        (
            ("simulate", "lighthouse", "--config", "{}", "-o", "out.mcap", "--duration", "2"),
            ("simulate", "dots", "--config", "{}", "-o", "out.mcap", "--frames", "1"),
            ("simulate", "polaris", "--config", "{}", "-o", "out.mcap"),
            ("simulate", "landmarks", "map.toml", "--config", "{}", "-o", "out.mcap"),
        ),
    ),
    "paths": Target(
        ("path.csv",),
        (mutations.damage_text,),
        (
            (
                *("simulate", "landmarks", "map.toml", "-o", "out.mcap"),
                *("--strategy", "path", "--path", "{}"),
            ),
        ),
    ),
    "stations": Target(
        ("stations.yaml",),
        (mutations.damage_text, mutations.damage_bytes),
        (("import", "crazyflie-config", "{}", "-o", "out.toml", "--json"),),
    ),
    "images": Target(
        tuple(f"frame.{ending}" for ending in ("png", "jpg", "bmp", "tif", "pgm", "webp")),
        (mutations.damage_bytes, mutations.damage_png),
        (
            ("import", "images", "{}", "-o", "out.mcap", "--sheet", "sheet.toml", "--json"),
        ),
    ),
    "scans": Target(
        ("scan.png",),
        (mutations.damage_png,),
        (("calibrate", "printer", "{}", "-o", "out.toml", "--json"),),
    ),
    "video": Target(
        ("frames.avi",),
        (mutations.damage_bytes,),
        (("import", "video", "{}", "-o", "out.mcap", "--json"),),
    ),
    "documents": Target(
        ("plan.pdf", "sheet2.pdf"),
        (mutations.damage_pdf,),
        (
            (*PRINT, "--ledger", "new.toml"),
            (*PRINT, "--ledger", "new.toml", "--strip-black"),
        ),
    ),
}  # fmt: skip


def fits(command: Words, name: str) -> bool:
    """Return True if a command is meant for a file of this name."""
    stem, _, ending = name.partition(".")
    verb = command[0]
    for wanted_stem in ("cameras", "prices", "task"):
        if f"--{wanted_stem}" in command:
            return stem == wanted_stem
    if stem == "room":
        return True
    if verb in ("map", "tag"):
        return ending != "toml" or stem == verb
    if verb == "simulate" and "--config" in command:
        return command[1] == stem.removesuffix("-sim")
    if verb == "calibrate":
        system = {"scene": "lighthouse", "camera": "dots", "tag": "polaris", "map": "landmarks"}
        return system.get(command[1], stem) == stem
    if verb == "import":
        wanted = {
            "dotbot-lh2": ("two", "one"),
            "polaris-csv": ("bar",),
            "landmark-csv": ("halls",),
            "dotbot-log": ("gateway",),
        }
        return stem in wanted.get(command[1], (stem,))
    if verb == "solve" and "--artifact" in command:
        artifact = {"lighthouse": "scene", "dots": "sheet", "polaris": "tag", "landmarks": "map"}
        return artifact[command[1].removesuffix(".mcap")] == stem
    if verb == "decode" and "--device" in command:
        return command[-1] in ("auto", stem.removesuffix("-raw"))
    if "crazyflie-config" in command or "dotbot-calibration" in command:
        return stem in ("lighthouse-solved", "scene")
    if "lighthouse.mcap" in command or "lighthouse-solved.mcap" in command:
        return stem in ("lighthouse", "lighthouse-solved", "robot-1", "truth")
    return True


# ---- cases


def run_case(
    target_name: str, seed: int, number: int, corpus: Path, keep: Path | None
) -> str | None:
    """Run one case and return what is wrong with its end, with all that is needed to repeat it."""
    target = TARGETS[target_name]
    rng = np.random.default_rng([seed, number, *target_name.encode()])
    files = [name for name in target.files if (corpus / name).exists()]
    name = files[int(rng.integers(len(files)))]
    commands = [command for command in target.commands if rng.random() < 0.1 or fits(command, name)]
    command = commands[int(rng.integers(len(commands)))]
    damage = target.damages[int(rng.integers(len(target.damages)))]
    if damage is mutations.damage_png and not name.endswith(".png"):
        damage = mutations.damage_bytes
    with tempfile.TemporaryDirectory(prefix="locatk-fuzz-") as temporary:
        folder = keep or Path(temporary)
        for path in corpus.iterdir():
            if not (folder / path.name).exists():
                os.link(path, folder / path.name)
        (folder / name).unlink()
        (folder / name).write_bytes(damage((corpus / name).read_bytes(), rng))
        before = {path.name for path in folder.iterdir()}
        words = [name if word == "{}" else word for word in command]
        result = run(words, folder)
        outputs = {word for word in words if word.startswith(("out", "new"))}
        left = sorted(
            path.name
            for path in folder.iterdir()
            if path.name not in before
            and not any(path.name.startswith(Path(each).stem) for each in outputs)
        )
        wrong = complaint(words, result, left)
        if result.status in (1, 2) and any(
            (folder / each).exists() for each in outputs if each.startswith("out")
        ):
            wrong = wrong or "an output in spite of a failure"
    if wrong is None:
        return None
    return (
        f"{wrong}\n  --only {target_name}:{seed}:{number}\n  locatk {' '.join(words)}\n"
        f"  status {result.status}, {result.seconds:.1f} s\n  {result.stderr[-1500:]}"
    )


def check_whole(corpus: Path) -> Iterator[str]:
    """Run the commands with undamaged files, which must succeed."""
    done: set[tuple[str, ...]] = set()
    for name, target in TARGETS.items():
        for command in target.commands:
            for file in target.files:
                words = tuple(file if word == "{}" else word for word in command)
                if not fits(command, file) or words in done or not (corpus / file).exists():
                    continue
                done.add(words)
                with tempfile.TemporaryDirectory(prefix="locatk-fuzz-") as temporary:
                    for path in corpus.iterdir():
                        os.link(path, Path(temporary) / path.name)
                    result = run(words, Path(temporary))
                wrong = complaint(words, result, ())
                if wrong or result.status not in (0, 3):
                    yield f"{name}: {' '.join(words)}: {wrong}, {result.stderr}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=None, help="time of all targets")
    parser.add_argument("--cases", type=int, default=None, help="cases of each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--target", action="append", choices=TARGETS, default=None)
    parser.add_argument("--only", metavar="TARGET:SEED:NUMBER", help="repeat one case")
    parser.add_argument("--keep", type=Path, help="folder for the files of --only")
    parser.add_argument(
        "--corpus", type=Path, help="folder of the valid files; made if it is empty"
    )
    parser.add_argument("--whole", action="store_true", help="run the undamaged files, too")
    parser.add_argument("--go-on", action="store_true", help="do not stop at a finding")
    arguments = parser.parse_args()
    import_program()
    findings = 0
    with contextlib.ExitStack() as stack:
        corpus = arguments.corpus
        if corpus is None:
            corpus = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="locatk-corpus-")))
        corpus.mkdir(parents=True, exist_ok=True)
        if not any(corpus.iterdir()):
            build_corpus(corpus)
        if arguments.only:
            name, seed, number = arguments.only.split(":")
            if arguments.keep:
                arguments.keep.mkdir(parents=True, exist_ok=True)
            wrong = run_case(name, int(seed), int(number), corpus, arguments.keep)
            print(wrong or "nothing wrong")
            return 1 if wrong else 0
        if arguments.whole:
            for wrong in check_whole(corpus):
                print(wrong)
                findings += 1
        names = arguments.target or list(TARGETS)
        end_s = time.monotonic() + arguments.seconds if arguments.seconds else float("inf")
        cases = (
            arguments.cases
            if arguments.cases is not None
            else (1 << 60 if arguments.seconds else 0)
        )
        number = 0
        while number < cases and time.monotonic() < end_s:
            for name in names:
                wrong = run_case(name, arguments.seed, number, corpus, None)
                if wrong:
                    findings += 1
                    print(wrong, flush=True)
                    if not arguments.go_on:
                        return 1
                if time.monotonic() >= end_s:
                    break
            number += 1
        print(f"{number} cases of each of {len(names)} targets, seed {arguments.seed}")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
