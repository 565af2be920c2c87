"""Reports in a real browser: figures are drawn, nothing is loaded, and there are no errors."""

from __future__ import annotations

import json
import re
import shutil
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from locatk.core.evaluation import evaluate
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.report.report import write_report
from locatk.formats.report.subject import Subject

pytestmark = pytest.mark.slow

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
EVIL = "</script><img src=http://example.invalid/x onerror=alert(1)><script>alert(2)</script>"


@pytest.fixture(scope="module")
def browser() -> str:
    """The browser; without one there is nothing to test."""
    for name in BROWSERS:
        found = shutil.which(name)
        if found:
            return found
    pytest.skip(f"none of {', '.join(BROWSERS)} is installed")


@dataclass(frozen=True)
class Opened:
    """An opened page: its elements as HTML, messages of the console, and requests."""

    dom: str
    console: list[str]
    requests: list[str]


def opened(browser: str, page: Path, profile: Path, *more: str) -> Opened:
    """Open a file and wait until its figures are drawn."""
    log = profile.with_suffix(".netlog")
    done = subprocess.run(
        [
            browser,
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--disable-background-networking",
            f"--user-data-dir={profile}",
            # Any request fails and is logged.
            "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--log-net-log={log}",
            "--enable-logging=stderr",
            "--virtual-time-budget=30000",
            "--window-size=1200,3000",
            *more,
            "--dump-dom",
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    events = re.findall(r'"url":"([^"]*)"', log.read_text(encoding="utf-8", errors="replace"))
    return Opened(done.stdout, console, events)


def subject(name: str = "red", n: int = 200) -> Subject:
    turn = np.linspace(0, 6, n)
    place = np.column_stack([np.cos(turn), np.sin(turn), 0.1 * turn])
    time_ns = 1_767_225_600_000_000_000 + 100_000_000 * np.arange(n)
    covariance = np.broadcast_to(np.eye(3) * 1e-6, (n, 3, 3))
    rng = np.random.default_rng(1)
    truth = Trajectory.from_positions(name, "floor", time_ns, place)
    noisy = place + 1e-3 * rng.standard_normal((n, 3))
    solved = Trajectory.from_positions(name, "floor", time_ns, noisy, covariance)
    scene = Scene(
        stations=(Station(1, np.array([-2.0, 0.0, 2.0]), np.eye(3), IDEAL_CALIBRATION),),
        markers=(Marker(name, np.array([0.5, 0.5, 0.0])),),
        scale="markers",
    )
    rejected = {"spike": 7, "jump": 2}
    solution = Solution(
        "lighthouse",
        "bundle",
        (solved,),
        rejected,
        artifact=scene,
        warnings=(SolverWarning("test", name),),
    )
    evaluation = evaluate([(solved, truth)])
    facts = {"command": f"locatk solve {name}", "source": name}
    return Subject(name, solution, facts, truth=(truth,), evaluation=evaluation)


@pytest.fixture(scope="module")
def page(browser: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Opened]:
    """A report of two subjects, the second with a name that would run a script; opened once."""
    folder = tmp_path_factory.mktemp("browser")
    path = folder / "report.html"
    write_report(path, [subject(), subject(EVIL)])
    return path.read_text(encoding="utf-8"), opened(browser, path, folder / "profile")


def test_all_figures_are_drawn(page: tuple[str, Opened]) -> None:
    source, shown = page
    wanted = source.count('<div class="figure"')
    assert wanted >= 14
    assert f'data-drawn="{wanted}"' in shown.dom
    figures = re.split(r'<div class="figure', shown.dom)[1:]
    assert len(figures) == wanted
    for figure in figures:
        size = re.search(r'<svg class="main-svg"[^>]*width="(\d+)" height="(\d+)"', figure)
        assert size is not None
        assert int(size[1]) > 600
        assert int(size[2]) >= 90
        # Lines, markers or bars with a shape of their own, not only axes.
        drawn = re.findall(
            r'<path[^>]*class="(?:js-line|point)[^"]*"[^>]*d="M[^"]{5,}"'
            r'|<path[^>]*d="M[^"]{5,}"[^>]*class="(?:js-line|point)'
            r'|<g class="point"><path d="M[^"]{5,}"|<path class="point[^>]*d="M',
            figure,
        )
        assert drawn, figure[:300]


def test_the_console_has_no_errors(page: tuple[str, Opened]) -> None:
    assert page[1].console == []


def test_nothing_is_loaded(page: tuple[str, Opened]) -> None:
    # The browser's own services may try; the page and what it names may not.
    asked = [url for url in page[1].requests if "example.invalid" in url or "plot" in url]
    assert asked == []


def test_names_of_devices_run_nothing(page: tuple[str, Opened]) -> None:
    dom = page[1].dom
    assert not re.search(r"<img[^>]*example\.invalid", dom)
    assert not re.search(r"<script>alert", dom)
    assert "&lt;/script&gt;" in dom  # it is shown as it is


def test_the_policy_blocks_injected_scripts_and_pictures(browser: str, tmp_path: Path) -> None:
    """A script and a picture that get into the page nevertheless neither run nor load."""
    path = tmp_path / "report.html"
    write_report(path, [subject()])
    text = path.read_text(encoding="utf-8")
    bad = "<script>document.title = 'bad'</script><img src=http://example.invalid/x.png onerror=a>"
    path.write_text(text.replace("</main>", f"{bad}</main>"), encoding="utf-8")
    shown = opened(browser, path, tmp_path / "profile")
    assert "<title>bad" not in shown.dom
    assert any("Content Security Policy" in line for line in shown.console)
    assert not any("example.invalid" in url for url in shown.requests)
    assert json.dumps("s1") in shown.dom  # and the page is there
    # Without the policy both would: the log tells what is asked for.
    path.write_text(path.read_text(encoding="utf-8").replace("Content-Security-Policy", "none"))
    shown = opened(browser, path, tmp_path / "other")
    assert "<title>bad" in shown.dom
    assert any("example.invalid" in url for url in shown.requests)


def test_the_page_is_not_blank(browser: str, tmp_path: Path) -> None:
    """Colours of all parts are in a picture of the page: it is not blank."""
    cv2 = pytest.importorskip("cv2")
    path, picture = tmp_path / "report.html", tmp_path / "page.png"
    write_report(path, [subject()])
    opened(browser, path, tmp_path / "profile", f"--screenshot={picture}")
    data = picture.read_bytes()
    assert struct.unpack(">II", data[16:24])[0] == 1200
    image = cv2.imread(str(picture)).reshape(-1, 3).astype(int)
    blue = np.abs(image - [0xB2, 0x72, 0x00]).max(axis=1) < 12  # of the path; cv2 has b, g, r
    grey = np.abs(image - 0xBF).max(axis=1) < 6  # of the truth
    assert blue.sum() > 500
    assert grey.sum() > 20


def test_a_narrow_window_shows_all(browser: str, tmp_path: Path) -> None:
    """As on a phone: legends go above, maps get lower, and rows of diagrams can be scrolled."""
    path = tmp_path / "report.html"
    write_report(path, [subject()])
    frame = tmp_path / "frame.html"
    frame.write_text(f'<iframe src="{path.as_uri()}" style="width:390px;height:9000px"></iframe>')
    script = (
        "<script>const f = document.documentElement.clientWidth;"
        "document.title = f + ' ' + document.documentElement.scrollWidth;</script>"
    )
    text = path.read_text(encoding="utf-8")
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)
    path.write_text(text.replace("</body>", f"{script}</body>"), encoding="utf-8")
    picture = tmp_path / "page.png"
    shown = opened(browser, frame, tmp_path / "profile", f"--screenshot={picture}")
    assert shown.console == []
    narrow = opened(browser, path, tmp_path / "other", "--window-size=500,3000").dom
    heights = [int(h) for h in re.findall(r'class="figure[^>]*height: (\d+)px', narrow)]
    assert heights[0] < 500  # the map, 640 in a wide window
    (wide, all_of_it) = map(int, re.findall(r"<title>(\d+) (\d+)</title>", narrow)[0])
    assert wide <= 600
    assert all_of_it == wide  # nothing sticks out at the side
