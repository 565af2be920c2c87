"""Remake the pictures of the first-hour guides from the commands that stand on their pages.

The ``sh`` blocks of a page run in order in a temporary folder, as a reader would run them; what
they wrote is brought to the size of a page. ``locatk`` must be on the PATH, with ``locatk[test]``
(for pypdfium2); pages of HTML need Chromium.

Examples
--------
::

    python .ci/pictures.py                # every guide
    python .ci/pictures.py polaris dots
    python .ci/pictures.py dots --keep /tmp/here   # and leave what the commands wrote
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pypdfium2
from PIL import Image

DOCS = Path(__file__).resolve().parent.parent / "docs"

LARGEST_BYTES = 150_000

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")

LIMIT_S = 60.0


@dataclass(frozen=True)
class Picture:
    """A picture of a guide.

    Attributes
    ----------
    name : str
        ``docs/images/first-hour-<name>.png``.
    source : str
        What the commands wrote: PNG, PDF or HTML.
    width : int
        In pixels; smaller sources are not made larger.
    page : int
        Of a PDF, from 0.
    box : tuple of float
        The part to show, from the upper left corner: left, top, right, bottom as shares of the
        source. Of HTML, of a window of 1100 x 1600 px.
    """

    name: str
    source: str
    width: int = 900
    page: int = 0
    box: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)


PICTURES = {
    "lighthouse": (
        Picture("lighthouse", "report.png"),
        Picture("lighthouse-report", "report.html", 800),
    ),
    "polaris": (
        Picture("polaris", "report.png"),
        Picture("polaris-tag", "tags.pdf", 480, box=(0.2, 0.06, 0.82, 0.475)),
        Picture("polaris-report", "report.html", 800),
    ),
    "dots": (
        Picture("dots", "report.png"),
        Picture("dots-sheet", "floor.pdf", 640, box=(0.0, 0.935, 0.14, 0.99)),
        Picture("dots-report", "report.html", 800),
    ),
    "landmarks": (
        Picture("landmarks", "report.png"),
        Picture("landmarks-plan", "pack.pdf", 560, box=(0.03, 0.02, 1.0, 0.59)),
        Picture("landmarks-template", "pack.pdf", 480, page=2, box=(0.04, 0.02, 1.0, 0.74)),
        Picture("landmarks-report", "report.html", 800),
    ),
}


# ---- the commands of a page


def run(page: Path, folder: Path) -> None:
    """All ``sh`` blocks of ``page`` in ``folder``; ``locatk emulate`` runs beside the others.

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
                stack.enter_context(beside(body, folder))
                continue
            for line in body.replace("\\\n", " ").splitlines():
                print(f"  {line}")
                done = subprocess.run(["bash", "-c", line], cwd=folder, capture_output=True)
                if done.returncode not in (0, 3):
                    raise SystemExit(f"{page.name}: {line}\n{done.stderr.decode()}")


@contextmanager
def beside(line: str, folder: Path) -> Iterator[None]:
    """The other terminal: ``line`` runs until the page is over."""
    print(f"  {line.strip()}  # beside the others")
    process = subprocess.Popen(
        line.split(), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    link = folder / re.search(r"--link (\S+)", line)[1]  # type: ignore[index]
    try:
        give_up = time.monotonic() + LIMIT_S
        while not link.is_symlink() and process.poll() is None and time.monotonic() < give_up:
            time.sleep(0.05)
        yield
    finally:
        process.terminate()
        process.wait()


# ---- pictures


def read(picture: Picture, folder: Path) -> Image.Image:
    """What the commands wrote, as pixels at least as wide as the picture."""
    source = folder / picture.source
    left, top, right, bottom = picture.box
    if source.suffix == ".pdf":
        page = pypdfium2.PdfDocument(source)[picture.page]
        # Twice as fine as needed: hair lines stay visible when it is made smaller.
        scale = 2 * picture.width / (page.get_width() * (right - left))
        image = page.render(scale=scale).to_pil()
    else:
        shot = folder / "screenshot.png"
        image = Image.open(screenshot(source, shot) if source.suffix == ".html" else source)
    wide, high = image.size
    cut = (round(left * wide), round(top * high), round(right * wide), round(bottom * high))
    return image.convert("RGB").crop(cut)


def screenshot(source: Path, target: Path) -> Path:
    """A page of HTML as a browser shows it."""
    browser = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if browser is None:
        raise SystemExit(f"No browser for {source.name}. Hint: apt-get install chromium.")
    subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        + ["--window-size=1100,1600", "--virtual-time-budget=5000"]
        + [f"--screenshot={target}", source.resolve().as_uri()],
        check=True,
        capture_output=True,
        timeout=LIMIT_S,
    )
    return target


def write(image: Image.Image, path: Path, width: int) -> None:
    """As PNG of ``width`` and few colours.

    Raises
    ------
    SystemExit
        It has more than 150 kB.
    """
    if image.width > width:
        high = round(image.height * width / image.width)
        image = image.resize((width, high), Image.Resampling.LANCZOS)
    few = image.quantize(128, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    size = path.stat().st_size
    print(f"  {path.name}: {image.width} x {image.height} px, {size / 1e3:.0f} kB")
    if size > LARGEST_BYTES:
        raise SystemExit(f"{path} has more than {LARGEST_BYTES} bytes")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("system", nargs="*", help=f"{', '.join(PICTURES)}; all, unless told")
    parser.add_argument("--keep", type=Path, help="a new folder for what the commands write")
    options = parser.parse_args()
    if unknown := set(options.system) - set(PICTURES):
        parser.error(f"no guide of {', '.join(sorted(unknown))}")
    for system in options.system or PICTURES:
        print(system)
        with tempfile.TemporaryDirectory() as temporary:
            folder = (options.keep or Path(temporary)) / system
            folder.mkdir(parents=True)
            run(DOCS / f"first-hour-{system}.md", folder)
            for picture in PICTURES[system]:
                path = DOCS / "images" / f"first-hour-{picture.name}.png"
                write(read(picture, folder), path, picture.width)


if __name__ == "__main__":
    main()
