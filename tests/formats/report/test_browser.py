"""Reports in a real browser: figures are drawn, nothing is loaded, and there are no errors."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.evaluation import evaluate
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.shapes import COLORS
from locatk.formats.report.report import write_report
from locatk.formats.report.style import MAX_EAGER_FIGURES
from locatk.formats.report.subject import Subject
from locatk.formats.report.theme import DARK_DEVICE_COLORS, PAGE_COLORS

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


def opened(browser: str, page: Path, profile: Path, *more: str, part: str = "") -> Opened:
    """Open a file, at a part of the page if there is one, and wait until its figures are drawn."""
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
            page.as_uri() + part,
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


@dataclass(frozen=True)
class Page(Opened):
    """An opened report: its source and a screenshot of it."""

    source: str
    screenshot: Path


@pytest.fixture(scope="module")
def page(browser: str, tmp_path_factory: pytest.TempPathFactory) -> Page:
    """A report of two subjects, the second with a name that would run a script; opened once."""
    folder = tmp_path_factory.mktemp("browser")
    path, picture = folder / "report.html", folder / "page.png"
    write_report(path, [subject(), subject(EVIL)])
    shown = opened(browser, path, folder / "profile", f"--screenshot={picture}")
    return Page(**vars(shown), source=path.read_text(encoding="utf-8"), screenshot=picture)


@pytest.fixture(scope="module")
def frames(browser: str, tmp_path_factory: pytest.TempPathFactory) -> Opened:
    """Three variants of a report in frames of one page, which shows what their scripts report.

    ``narrow`` reports its sizes when all is drawn; its window is as wide as a phone. A script and
    a picture were added to ``blocked`` and to ``allowed``, which lacks the policy.
    """
    folder = tmp_path_factory.mktemp("frames")
    path = folder / "report.html"
    write_report(path, [subject()])
    report = path.read_text(encoding="utf-8")
    measure = """<script>
        new MutationObserver(function () {
          const root = document.documentElement, figure = document.querySelector(".figure");
          const sizes = [root.clientWidth, root.scrollWidth, figure.clientHeight];
          parent.postMessage("narrow: " + root.dataset.drawn + " " + sizes.join(" "), "*");
        }).observe(document.documentElement, {attributeFilter: ["data-drawn"]});
        </script>"""
    no_figures = re.sub(r'<div class="wide">.*?</script>', "", report, flags=re.DOTALL)
    bad = (
        "<script>parent.postMessage('NAME ran', '*')</script>"
        "<img src=http://example.invalid/NAME.png onerror=\"parent.postMessage('NAME ran', '*')\">"
    )
    variants = {
        "narrow": _without_policy(report).replace("<main>", f"{measure}<main>"),
        "blocked": no_figures.replace("</main>", f"{bad}</main>"),
        "allowed": _without_policy(no_figures).replace("</main>", f"{bad}</main>"),
    }
    show = "addEventListener('message', event => document.body.append(`[${event.data}]`))"
    page = f"<script>{show}</script>"
    for name, text in variants.items():
        (folder / f"{name}.html").write_text(text.replace("NAME", name), encoding="utf-8")
        page += f'<iframe src="{name}.html" style="width:390px"></iframe>'
    (folder / "frames.html").write_text(page)
    return opened(browser, folder / "frames.html", folder / "profile")


def _without_policy(page: str) -> str:
    changed, count = re.subn(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    assert count == 1
    return changed


def test_all_figures_are_drawn(page: Page) -> None:
    wanted = page.source.count('<div class="figure"')
    assert wanted >= 14
    assert f'data-drawn="{wanted}"' in page.dom
    figures = re.split(r'<div class="figure', page.dom)[1:]
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


def test_the_console_has_no_errors(page: Page) -> None:
    assert page.console == []


def test_nothing_is_loaded(page: Page) -> None:
    # The browser's own services may try; the page and what it names may not.
    asked = [url for url in page.requests if "example.invalid" in url or "plot" in url]
    assert asked == []


def test_names_of_devices_run_nothing(page: Page) -> None:
    dom = page.dom
    assert not re.search(r"<img[^>]*example\.invalid", dom)
    assert not re.search(r"<script>alert", dom)
    assert "&lt;/script&gt;" in dom  # it is shown as it is


def test_the_policy_blocks_injected_scripts_and_pictures(frames: Opened) -> None:
    """A script and a picture that get into the page nevertheless neither run nor load."""
    assert "[blocked ran]" not in frames.dom
    assert not any("example.invalid/blocked.png" in url for url in frames.requests)
    refused = [line for line in frames.console if "Content Security Policy" in line]
    assert all("blocked.html" in line for line in refused)
    assert any("script" in line for line in refused)
    assert any("example.invalid/blocked.png" in line for line in refused)
    # Without the policy both would: the log tells what is asked for.
    assert "[allowed ran]" in frames.dom
    assert any("example.invalid/allowed.png" in url for url in frames.requests)


def test_the_page_is_not_blank(page: Page) -> None:
    """Colours of all parts are in a picture of the page: it is not blank."""
    cv2 = pytest.importorskip("cv2")
    data = page.screenshot.read_bytes()
    assert struct.unpack(">II", data[16:24])[0] == 1200
    image = cv2.imread(str(page.screenshot)).reshape(-1, 3).astype(np.int16)
    blue = np.abs(image - [0xB2, 0x72, 0x00]).max(axis=1) < 12  # of the path; cv2 has b, g, r
    grey = np.abs(image - 0x8C).max(axis=1) < 6  # of the truth
    assert blue.sum() > 500
    assert grey.sum() > 20


DARK = "--blink-settings=preferredColorScheme=0"
"""Switch by which Chromium prefers a dark color scheme."""


def test_dark_mode_changes_the_page_and_its_diagrams(browser: str, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    path, picture = tmp_path / "report.html", tmp_path / "page.png"
    write_report(path, [subject()])
    shown = opened(browser, path, tmp_path / "profile", DARK, f"--screenshot={picture}")
    assert shown.console == []
    image = cv2.imread(str(picture))[:, :, ::-1].reshape(-1, 3).astype(np.int16)

    def fraction(color: str) -> float:
        channels = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
        return float(np.mean(np.abs(image - channels).max(axis=1) < 3))

    for name, least in (("page", 0.05), ("card", 0.3)):
        light, dark = PAGE_COLORS[name]
        assert fraction(light) < 1e-3
        assert fraction(dark) > least
    assert fraction(DARK_DEVICE_COLORS[0]) > 1e-4
    assert fraction(COLORS[0]) < 1e-5
    # Text and axes of the diagrams, in the notation of plotly.
    assert "fill: rgb(230, 235, 240)" in shown.dom
    assert "fill: rgb(29, 39, 51)" not in shown.dom


def test_dark_mode_prints_light_diagrams(browser: str, tmp_path: Path) -> None:
    """A report that is printed has the light colors, and the dark ones again afterwards."""
    path = tmp_path / "report.html"
    write_report(path, [subject()])
    report = _without_policy(path.read_text("utf-8"))
    measure = """<script>
        new MutationObserver(function () {
          const axis = () => document.querySelector(".figure .xtick text").style.fill;
          const figure = document.querySelector(".figure");
          const excess = () => figure.querySelector(".main-svg").clientHeight - figure.clientHeight;
          const colors = [axis()], excesses = [];
          for (const name of ["beforeprint", "afterprint"]) {
            window.dispatchEvent(new Event(name));
            colors.push(axis());
            excesses.push(excess());
          }
          document.body.append("[" + colors.join("; ") + "] [" + excesses + "]");
        }).observe(document.documentElement, {attributeFilter: ["data-drawn"]});
        </script>"""
    path.write_text(report.replace("<main>", f"{measure}<main>"), "utf-8")
    dom = opened(browser, path, tmp_path / "profile", DARK).dom
    assert "[rgb(230, 235, 240); rgb(29, 39, 51); rgb(230, 235, 240)]" in dom
    assert "[0,0]" in dom  # No map covers the figure below it.


def test_a_narrow_window_shows_all(frames: Opened) -> None:
    """As on a phone: legends go above, maps get lower, and rows of diagrams can be scrolled."""
    assert not any("narrow.html" in line for line in frames.console)
    reported = re.findall(r"\[narrow: (\d+) (\d+) (\d+) (\d+)\]", frames.dom)
    assert len(reported) == 1
    drawn, width, whole_width, map_height = map(int, reported[0])
    assert drawn >= 7
    assert 370 <= width <= 390  # a scroll bar may take some
    assert whole_width == width  # nothing sticks out at the side
    assert map_height < 500  # 640 in a wide window


@pytest.mark.slow
def test_the_overview_is_sorted_by_a_click(browser: str, tmp_path: Path) -> None:
    """Numbers by their size, in whatever unit; a second click reverses the order."""
    path = tmp_path / "report.html"
    write_report(path, [subject("r2", n=40), subject("r10", n=60), subject("r1", n=20)])
    report = re.sub(r'<div class="wide">.*?</script>', "", path.read_text("utf-8"), flags=re.S)
    click = """<script>addEventListener("load", function () {
        const buttons = document.querySelectorAll(".sortable th button");
        for (const clicks of [1, 2]) {
          buttons[5].click();
          const cells = document.querySelectorAll(".sortable tbody td:nth-child(6)");
          document.body.append("[" + Array.from(cells).map(cell => cell.textContent) + "]");
        }
        document.body.append("[" + buttons[5].parentNode.getAttribute("aria-sort") + "]");
        // The links are those of their rows, wherever these are now.
        for (const link of document.querySelectorAll(".sortable tbody a")) {
          link.click();
          const target = document.querySelector(":target");
          document.body.append(`[${link.textContent}: ${target.querySelector("h2").textContent}`);
          document.body.append(` ${target.tagName}]`);
        }
      });</script>"""
    path.write_text(_without_policy(report).replace("</body>", f"{click}</body>"), "utf-8")
    dom = opened(browser, path, tmp_path / "profile").dom
    assert "[20,40,60][60,40,20][descending]" in dom
    for name in ("r10", "r2", "r1"):
        assert f"[{name}: {name} ARTICLE]" in dom


@pytest.mark.slow
def test_a_page_of_many_figures_draws_those_in_sight(browser: str, tmp_path: Path) -> None:
    """All together would take minutes; a link to a solution draws its figures."""
    path = tmp_path / "report.html"
    shown = subject(n=20)
    write_report(path, [replace(shown, name=f"r{k}") for k in range(1, 21)])
    report = path.read_text("utf-8")
    total = report.count('<div class="figure"')
    assert total > MAX_EAGER_FIGURES
    # Without a smooth motion over the figures between the beginning and the solution.
    jump = "--force-prefers-reduced-motion"
    dom = opened(browser, path, tmp_path / "profile", jump, part="#s15").dom
    drawn = {int(k) for k in re.findall(r'id="s(\d+)-\d+-figure"[^>]*class="[^"]*js-plotly', dom)}
    drawn |= {int(k) for k in re.findall(r'class="[^"]*js-plotly[^>]*id="s(\d+)-\d+-figure"', dom)}
    assert 15 in drawn
    assert len(drawn) < 10
    count = re.search(r'data-drawn="(\d+)"', dom)
    assert count is not None
    assert 3 <= int(count[1]) < total / 2
