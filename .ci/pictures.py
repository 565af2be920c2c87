"""Remake the pictures of the documentation from the outputs of commands.

The ``sh`` blocks of a first-hour guide run in order in a temporary folder; other pictures are made
by :data:`COMMANDS`. The outputs are cropped and scaled. Pictures of the page of ``locatk live`` are
taken while it plays a session. ``locatk`` must be on the PATH, with ``locatk[test]`` (for
pypdfium2); HTML needs Chromium.

Examples
--------
::

    python .ci/pictures.py                # all pictures
    python .ci/pictures.py polaris dots
    python .ci/pictures.py dots --keep /tmp/here   # keep the outputs of the commands
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pypdfium2
from PIL import Image

DOCS = Path(__file__).resolve().parent.parent / "docs"

MAX_PICTURE_BYTES = 150_000
"""Largest file that is accepted into the repository."""

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
"""Names of the browser; the first one on the PATH is used."""

TIMEOUT_S = 60.0
"""Time limit of the browser, and of `locatk emulate` until its port exists."""

LIVE_SIZE_PX = (1300, 850)
"""Width and height of the window with the page of `locatk live`."""


@dataclass(frozen=True)
class Picture:
    """Picture of the documentation.

    Attributes
    ----------
    name : str
        Name in ``docs/images``, without ``.png``.
    source : str
        Output of the commands: PNG, PDF or HTML.
    width : int
        Width in pixels; smaller sources are not enlarged.
    page : int
        Page of a PDF, from 0.
    box : tuple of float
        Visible part: left, top, right, bottom as fractions of the source, from the upper left
        corner. The source of HTML is a window of 1100 x 1600 px.
    """

    name: str
    source: str
    width: int = 900
    page: int = 0
    box: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True)
class LivePicture:
    """Picture of the page of ``locatk live`` while it plays a session.

    Attributes
    ----------
    name : str
        As of :class:`Picture`.
    command : str
        ``locatk live replay:...``, without its sink.
    pose : int
        Number of poses of all devices after which the picture is taken.
    width : int
        Width in pixels.
    """

    name: str
    command: str
    pose: int
    width: int = 900


PICTURES: dict[str, tuple[Picture | LivePicture, ...]] = {
    "lighthouse": (
        Picture("first-hour-lighthouse", "report.png"),
        Picture("first-hour-lighthouse-report", "report.html", 800),
        LivePicture(
            "first-hour-lighthouse-live", "locatk live replay:run.mcap --artifact scene.toml", 150
        ),
    ),
    "polaris": (
        Picture("first-hour-polaris", "report.png"),
        Picture("first-hour-polaris-tag", "tags.pdf", 480, box=(0.2, 0.06, 0.82, 0.475)),
        Picture("first-hour-polaris-report", "report.html", 800),
        LivePicture("first-hour-polaris-live", "locatk live replay:tour.mcap", 550),
    ),
    "dots": (
        Picture("first-hour-dots", "report.png"),
        Picture("first-hour-dots-sheet", "floor.pdf", 640, box=(0.0, 0.935, 0.14, 0.99)),
        Picture("first-hour-dots-report", "report.html", 800),
        LivePicture("first-hour-dots-live", "locatk live replay:sim.mcap", 110),
    ),
    "landmarks": (
        Picture("first-hour-landmarks", "report.png"),
        Picture("first-hour-landmarks-plan", "pack.pdf", 560, box=(0.03, 0.02, 1.0, 0.59)),
        Picture(
            "first-hour-landmarks-template", "pack.pdf", 480, page=2, box=(0.04, 0.02, 1.0, 0.74)
        ),
        Picture("first-hour-landmarks-report", "report.html", 800),
        LivePicture(
            "first-hour-landmarks-live", "locatk live replay:drive.mcap --artifact halls.toml", 860
        ),
    ),
    "demo": (Picture("demo", "demo/lighthouse.png", 1200),),
    "floor": (
        Picture("landmarks", "report.png", 1200),
        Picture("landmarks-plan", "pack.pdf", 655, box=(0.0, 0.0, 1.0, 0.53)),
        Picture("landmarks-template", "pack.pdf", 655, page=7, box=(0.04, 0.02, 1.0, 0.77)),
    ),
}
"""Pictures of each guide, and of each entry of :data:`COMMANDS`."""

COMMANDS = {
    "demo": ("locatk demo lighthouse --keep demo",),
    "floor": (
        "locatk map design 8x12 --name lab -o map.toml",
        "locatk print landmarks map.toml -o pack.pdf",
        "locatk simulate landmarks map.toml -o run.mcap",
        "locatk solve run.mcap -o solved.mcap",
        "locatk report solved.mcap -o report.html --png",
    ),
}
"""Commands of pictures that are not from a guide."""


# ---- commands


def run_guide(page: Path, folder: Path) -> None:
    """Run all ``sh`` blocks of ``page`` in ``folder``, with ``locatk emulate`` in the background.

    Raises
    ------
    SystemExit
        A command ended with another status than 0 and 3.
    """
    text = page.read_text(encoding="utf-8")
    with ExitStack() as stack:
        for file, language, body in re.findall(
            r"^(?:<!-- guide: file (\S+) -->\n+)?```(\w*)\n(.*?)^```$", text, re.M | re.S
        ):
            if file:
                (folder / file).write_text(body, encoding="utf-8")
            if language != "sh":
                continue
            if body.startswith("locatk emulate "):
                stack.enter_context(running(body, folder))
                continue
            for line in body.replace("\\\n", " ").splitlines():
                run(line, folder)


def run(line: str, folder: Path) -> None:
    """Run a command in ``folder``.

    Raises
    ------
    SystemExit
        It ended with another status than 0 and 3.
    """
    print(f"  {line}")
    process = subprocess.run(["bash", "-c", line], cwd=folder, capture_output=True)
    if process.returncode not in (0, 3):
        raise SystemExit(f"{line}\n{process.stderr.decode()}")


@contextmanager
def running(line: str, folder: Path) -> Iterator[None]:
    """Run ``locatk emulate`` in the background until the context ends."""
    print(f"  {line.strip()} &")
    process = subprocess.Popen(
        line.split(), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    link = folder / re.search(r"--link (\S+)", line)[1]  # type: ignore[index]
    try:
        deadline = time.monotonic() + TIMEOUT_S
        while not link.is_symlink() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        yield
    finally:
        process.terminate()
        process.wait()


# ---- page of a live session


def live_page(picture: LivePicture, folder: Path) -> Image.Image:
    """Play a session, and return the page once its poses are there.

    Raises
    ------
    SystemExit
        The session ended before.
    """
    sys.path.insert(0, str(DOCS.parent / "tests"))
    from live_servers import Browser

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url = f"http://127.0.0.1:{port}/"
    browser = Browser(Path(tempfile.mkdtemp(dir=folder)))
    command = f"{picture.command} --to web://:{port} --json"
    print(f"  {command}")
    process = subprocess.Popen(
        command.split(), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        poses = 0
        assert process.stdout is not None
        for line in process.stdout:
            if poses == 0:
                browser.open(url, *LIVE_SIZE_PX)
            poses += json.loads(line)["type"] == "pose"
            if poses == picture.pose:
                return Image.fromarray(browser.picture())
        raise SystemExit(f"{command} ended after {poses} poses")
    finally:
        process.terminate()
        process.wait()
        browser.close()


# ---- pictures


def read(picture: Picture, folder: Path) -> Image.Image:
    """Read the visible part of an output, at least as wide as the picture."""
    source = folder / picture.source
    left, top, right, bottom = picture.box
    if source.suffix == ".pdf":
        page = pypdfium2.PdfDocument(source)[picture.page]
        # Twice the final resolution, so that thin lines remain visible after the reduction.
        scale = 2 * picture.width / (page.get_width() * (right - left))
        image = page.render(scale=scale).to_pil()
    else:
        shot = folder / "screenshot.png"
        image = Image.open(screenshot(source, shot) if source.suffix == ".html" else source)
    wide, high = image.size
    cut = (round(left * wide), round(top * high), round(right * wide), round(bottom * high))
    return image.convert("RGB").crop(cut)


def screenshot(source: Path, target: Path) -> Path:
    """Write the picture of an HTML page in a browser."""
    browser = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if browser is None:
        raise SystemExit(f"No browser for {source.name}. Hint: apt-get install chromium.")
    subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        + ["--window-size=1100,1600", "--virtual-time-budget=5000"]
        + [f"--screenshot={target}", source.resolve().as_uri()],
        check=True,
        capture_output=True,
        timeout=TIMEOUT_S,
    )
    return target


def write(image: Image.Image, path: Path, width: int) -> None:
    """Write a PNG of at most ``width`` pixels with 128 colours.

    Raises
    ------
    SystemExit
        The file is larger than :data:`MAX_PICTURE_BYTES`.
    """
    if image.width > width:
        high = round(image.height * width / image.width)
        image = image.resize((width, high), Image.Resampling.LANCZOS)
    reduced = image.quantize(128, dither=Image.Dither.NONE)
    reduced.save(path, optimize=True)
    size = path.stat().st_size
    print(f"  {path.name}: {image.width} x {image.height} px, {size / 1e3:.0f} kB")
    if size > MAX_PICTURE_BYTES:
        raise SystemExit(f"{path} has more than {MAX_PICTURE_BYTES} bytes")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", nargs="*", help=f"{', '.join(PICTURES)}  [default: all]")
    parser.add_argument("--keep", type=Path, help="new folder for the outputs of the commands")
    options = parser.parse_args()
    if unknown := set(options.source) - set(PICTURES):
        parser.error(f"no pictures of {', '.join(sorted(unknown))}")
    for source in options.source or PICTURES:
        print(source)
        with tempfile.TemporaryDirectory() as temporary:
            folder = (options.keep or Path(temporary)) / source
            folder.mkdir(parents=True)
            if source in COMMANDS:
                for line in COMMANDS[source]:
                    run(line, folder)
            else:
                run_guide(DOCS / f"first-hour-{source}.md", folder)
            for picture in PICTURES[source]:
                path = DOCS / "images" / f"{picture.name}.png"
                is_live = isinstance(picture, LivePicture)
                image = live_page(picture, folder) if is_live else read(picture, folder)
                write(image, path, picture.width)


if __name__ == "__main__":
    main()
