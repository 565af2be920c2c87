"""Programs that rasterise PDFs: those of printers, viewers and browsers.

All are run as programs, except for pdfium; MuPDF (AGPL) is never imported. Pages are (height,
width) uint8 arrays, 0 for black and 255 for white.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError, MissingDataError

Grey = NDArray[np.uint8]

TIMEOUT_S = 600
"""Longest duration of a program, and of a page in a browser [s]."""

PDFJS_VARIABLE = "LOCATK_PDFJS"
"""Environment variable with the folder of the npm package `pdfjs-dist`."""

BROWSERS = ("chromium", "chromium-browser", "google-chrome")

MAX_CANVAS_PX = 65_535
"""Longest side of a canvas in Chromium; a longer one remains empty."""

INKS = ("Cyan", "Magenta", "Yellow", "Black")


@dataclass(frozen=True)
class Rasteriser:
    """Rasteriser of PDFs.

    Attributes
    ----------
    name : str
    missing : callable
        Returns the reason why it cannot be used on this machine, else None.
    rasterise : callable
        Yields the pages of a PDF; its arguments are the file, dpi, and an empty folder.
    max_side_px : int or None
        Longest side of a page that it can draw.
    """

    name: str
    missing: Callable[[], str | None]
    rasterise: Callable[[Path, int, Path], Iterator[Grey]]
    max_side_px: int | None = None


def _missing_program(name: str) -> str | None:
    return None if shutil.which(name) else f"{name} is not installed"


def _run(*command: str | Path) -> None:
    """Run a program.

    Raises
    ------
    LocatkError
        It fails or does not end.
    """
    try:
        subprocess.run(
            command, check=True, capture_output=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        raise LocatkError(f"{command[0]} did not end in {TIMEOUT_S} s") from None
    except subprocess.CalledProcessError as error:
        words = " ".join(error.stderr.decode(errors="replace").split())
        raise LocatkError(f"{command[0]} failed: {words[-200:]}") from None


def _read_pages(folder: Path, pattern: str) -> Iterator[Grey]:
    """Read the images of numbered pages, and remove each from the disk."""
    for path in sorted(
        folder.glob(pattern), key=lambda path: int(re.findall(r"\d+", path.name)[0])
    ):
        yield _read_image(path)
        path.unlink()


def _read_image(path: Path) -> Grey:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise MissingDataError("no image", file=path)
    return image


def _run_ghostscript(device: str, pdf: Path, dpi: int, folder: Path) -> None:
    _run("gs", "-q", "-dNOPAUSE", "-dBATCH", "-dSAFER", f"-sDEVICE={device}", f"-r{dpi}",
         f"-sOutputFile={folder / 'page%d'}", pdf)  # fmt: skip


def _ghostscript(device: str, pdf: Path, dpi: int, folder: Path) -> Iterator[Grey]:
    _run_ghostscript(device, pdf, dpi, folder)
    yield from _read_pages(folder, "page*")


def rasterise_inks(pdf: Path, dpi: int, folder: Path) -> Iterator[dict[str, Grey]]:
    """Yield the separations of each page by ink, 0 for full ink, as Ghostscript makes them."""
    # Without the extension, and with the combined image next to the separations.
    _run_ghostscript("tiffsep", pdf, dpi, folder)
    count = len([path for path in folder.iterdir() if re.fullmatch(r"page\d+", path.name)])
    for number in range(1, count + 1):
        yield {ink: _read_image(folder / f"page{number}({ink}).tif") for ink in INKS}


def _black_ink(pdf: Path, dpi: int, folder: Path) -> Iterator[Grey]:
    return (plates["Black"] for plates in rasterise_inks(pdf, dpi, folder))


def _poppler(mode: str, pdf: Path, dpi: int, folder: Path) -> Iterator[Grey]:
    _run("pdftoppm", mode, "-r", str(dpi), pdf, folder / "page")
    yield from _read_pages(folder, "page-*")


def _mupdf(smoothing_bits: int, pdf: Path, dpi: int, folder: Path) -> Iterator[Grey]:
    _run("mutool", "draw", "-q", "-r", str(dpi), "-A", str(smoothing_bits), "-c", "gray",
         "-F", "pgm", "-o", folder / "page%d.pgm", pdf)  # fmt: skip
    yield from _read_pages(folder, "page*")


def _missing_pdfium() -> str | None:
    try:
        import pypdfium2  # noqa: F401 - optional: part of locatk[test]
    except ImportError:
        return "pypdfium2 is not installed (it comes with locatk[test])"
    return None


def _pdfium(pdf: Path, dpi: int, folder: Path) -> Iterator[Grey]:
    import pypdfium2  # optional: part of locatk[test]

    with contextlib.closing(pypdfium2.PdfDocument(str(pdf))) as document:
        for page in document:
            bitmap = page.render(scale=dpi / 72, grayscale=True)
            yield np.array(bitmap.to_numpy().squeeze())


# ---- pdf.js

PDFJS_PAGE = """<!doctype html><meta charset="utf-8"><canvas id="page"></canvas>
<script type="module">
const send = (path, body) => fetch(path, {method: "POST", body});
try {
  const pdfjs = await import("/pdfjs/build/pdf.min.mjs");
  pdfjs.GlobalWorkerOptions.workerSrc = "/pdfjs/build/pdf.worker.min.mjs";
  const file = await pdfjs.getDocument({url: "/document.pdf", wasmUrl: "/pdfjs/wasm/",
    standardFontDataUrl: "/pdfjs/standard_fonts/"}).promise;
  const canvas = document.getElementById("page");
  for (let number = 1; number <= file.numPages; number++) {
    const page = await file.getPage(number);
    const viewport = page.getViewport({scale: DPI / 72});
    const [width, height] = [Math.round(viewport.width), Math.round(viewport.height)];
    [canvas.width, canvas.height] = [width, height];
    const context = canvas.getContext("2d", {willReadFrequently: true});
    await page.render({canvas, canvasContext: context, viewport, intent: "print"}).promise;
    const grey = new Uint8Array(width * height);
    for (let row = 0; row < height; row += 256) {
      const colours = context.getImageData(0, row, width, Math.min(256, height - row)).data;
      for (let i = 1, k = row * width; i < colours.length; i += 4, k++) grey[k] = colours[i];
    }
    await send(`/page?width=${width}&height=${height}`, grey);
  }
  await send("/end", "");
} catch (error) {
  await send("/end", String(error));
}
</script>
"""
"""Page that draws a document on a canvas as wide as its pixels, and posts the green channel."""

CONTENT_TYPES = {".mjs": "text/javascript", ".pdf": "application/pdf", ".wasm": "application/wasm"}


def _browser() -> str | None:
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def _missing_pdfjs() -> str | None:
    if _browser() is None:
        return f"none of {', '.join(BROWSERS)} is installed"
    folder = os.environ.get(PDFJS_VARIABLE)
    if not folder or not (Path(folder) / "build" / "pdf.min.mjs").is_file():
        return f"{PDFJS_VARIABLE} is not the folder of the npm package pdfjs-dist"
    return None


def _pdfjs(pdf: Path, dpi: int, folder: Path) -> Iterator[Grey]:
    """Draw a PDF by pdf.js in a browser, which exchanges files with a server of this process."""
    pages: queue.Queue[Grey | str] = queue.Queue()
    package = Path(os.environ[PDFJS_VARIABLE]).resolve()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = urlsplit(self.path).path
            target = (package / path.removeprefix("/pdfjs/")).resolve()
            if path == "/":
                data, kind = PDFJS_PAGE.replace("DPI", str(dpi)).encode(), "text/html"
            elif path == "/document.pdf":
                data, kind = pdf.read_bytes(), CONTENT_TYPES[".pdf"]
            elif path.startswith("/pdfjs/") and target.is_relative_to(package) and target.is_file():
                data = target.read_bytes()
                kind = CONTENT_TYPES.get(target.suffix, "application/octet-stream")
            else:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def do_POST(self) -> None:
            data = self.rfile.read(int(self.headers["Content-Length"]))
            url = urlsplit(self.path)
            if url.path == "/page":
                sides = parse_qs(url.query)
                height, width = (int(sides[side][0]) for side in ("height", "width"))
                pages.put(np.frombuffer(data, np.uint8).reshape(height, width))
            else:
                pages.put(data.decode(errors="replace"))
            self.send_response(204)
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            pass

    with contextlib.ExitStack() as stack:
        server = stack.enter_context(ThreadingHTTPServer(("127.0.0.1", 0), Handler))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        stack.callback(server.shutdown)
        browser = subprocess.Popen(
            [
                str(_browser()),
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
                "--disable-background-networking",
                f"--user-data-dir={folder / 'profile'}",
                f"http://127.0.0.1:{server.server_port}/",
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        stack.callback(browser.wait)
        # The browser starts processes of its own, all in its group.
        stack.callback(os.killpg, browser.pid, signal.SIGKILL)
        try:
            while not isinstance(page := pages.get(timeout=TIMEOUT_S), str):
                yield page
        except queue.Empty:
            raise LocatkError(f"pdf.js did not end in {TIMEOUT_S} s") from None
        if page:
            raise LocatkError(f"pdf.js failed: {page}")


def _program(
    name: str, program: str, rasterise: Callable[[Path, int, Path], Iterator[Grey]]
) -> Rasteriser:
    return Rasteriser(name, partial(_missing_program, program), rasterise)


RASTERISERS = (
    Rasteriser("pdfium", _missing_pdfium, _pdfium),
    _program("MuPDF", "mutool", partial(_mupdf, 8)),
    _program("MuPDF, no anti-aliasing", "mutool", partial(_mupdf, 0)),
    _program("Ghostscript pbmraw", "gs", partial(_ghostscript, "pbmraw")),
    _program("Ghostscript pgmraw", "gs", partial(_ghostscript, "pgmraw")),
    _program("Ghostscript tiffsep", "gs", _black_ink),
    _program("poppler -mono", "pdftoppm", partial(_poppler, "-mono")),
    _program("poppler -gray", "pdftoppm", partial(_poppler, "-gray")),
    Rasteriser("pdf.js", _missing_pdfjs, _pdfjs, MAX_CANVAS_PX),
)
"""Rasterisers that sheets are tested with, the black ink of separations among them."""
