"""The documentation as a site, the index of its pages, and what they must tell of."""

from __future__ import annotations

import ast
import itertools
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

import pytest

from locatk.cli.app import COMMANDS
from locatk.cli.bench import BENCHES

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


# ---- the site


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; a warning fails its test."""
    pytest.importorskip("furo", reason="the site needs locatk[docs]")
    pytest.importorskip("myst_parser", reason="the site needs locatk[docs]")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q", "-b", "html"]
    command += ["-d", str(folder / "doctrees"), str(DOCS), str(folder / "html")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder / "html"


@pytest.mark.slow
def test_each_page_is_in_the_menu(site: Path) -> None:
    start = (site / "index.html").read_text(encoding="utf-8")
    (menu,) = re.findall(r'<div class="sidebar-tree">(.*?)</div>', start, re.S)
    linked = set(re.findall(r'href="([^"#]+)\.html"', menu))
    pages = {page.relative_to(DOCS).with_suffix("").as_posix() for page in PAGES}
    assert pages - {"index"} <= linked


@pytest.mark.slow
def test_first_page_is_the_readme(site: Path) -> None:
    start = (site / "index.html").read_text(encoding="utf-8")
    for heading in re.findall(r"^## (.*)$", (ROOT / "README.md").read_text("utf-8"), re.M):
        assert f"<h2>{heading}<" in start


@pytest.mark.slow
def test_nothing_is_fetched(site: Path) -> None:
    """Scripts, styles, fonts and pictures come with the pages: they open offline."""
    fetched = re.compile(
        r"<(?:script|img|iframe|source)[^>]*\ssrc=[\"']?(?:https?:)?//"
        r"|<link(?![^>]*rel=[\"'](?:canonical|license))[^>]*\shref=[\"']?(?:https?:)?//"
        r"|url\([\"']?(?:https?:)?//|@import[^;]*//"
    )
    for path in [*site.rglob("*.html"), *site.rglob("*.css")]:
        assert not fetched.search(path.read_text(encoding="utf-8")), path


@pytest.mark.slow
def test_search_works_without_a_network(site: Path, tmp_path: Path) -> None:
    """In a browser that opens the page as a file: results lead to pages that are there."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium")
    command = [chromium, "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += [f"--user-data-dir={tmp_path}", "--virtual-time-budget=10000"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND"]
    address = f"{(site / 'search.html').as_uri()}?q=homography"
    done = subprocess.run([*command, address], capture_output=True, text=True, timeout=120)
    found = re.search(r'<ul[^>]* class="search".*?</ul>', done.stdout, re.S)
    assert found, done.stdout
    results = re.findall(r'href="([^"#?]+\.html)', found[0])
    assert "lighthouse.html" in results
    assert all((site / page).is_file() for page in results)


# ---- pages


def test_each_page_is_in_the_index() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    linked = set(re.findall(r"\]\(([^)#]+)\)", index))
    assert {page.relative_to(DOCS).as_posix() for page in PAGES} - {"index.md"} <= linked


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_is_told_of(name: str) -> None:
    """In a page that people wrote, not only in the commands' own help."""
    texts = [p.read_text(encoding="utf-8") for p in [*PAGES, ROOT / "README.md"]
             if p.name != "commands.md"]  # fmt: skip
    assert any(re.search(rf"\blocatk {name}\b", text) for text in texts)


# ---- figures of the bench

Values = dict[str, list[ast.expr]]
"""What the variables of a function may be, as far as its text tells."""


def _modules(system: str) -> Iterator[ast.Module]:
    """The module of a bench, and those that it imports figures from, but not other benches."""
    package = "locatk.formats.benchmarks"
    start = BENCHES[system].split(":")[0]
    packages = {entry.split(":")[0].rpartition(".")[0] for entry in BENCHES.values()}
    others = tuple(f"{each}." for each in packages - {package, start.rpartition(".")[0]})
    # The names of ratios are given by their callers.
    left, seen = [start], {f"{package}.timing", f"{package}.plan.ratios"}
    while left:
        name = left.pop()
        if name in seen or not name.startswith(f"{package}.") or name.startswith(others):
            continue
        seen.add(name)
        path = ROOT / Path(*name.split(".")[1:]).with_suffix(".py")
        if not path.exists():
            continue  # a package
        module = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(module):
            if isinstance(node, ast.ImportFrom):
                left += [f"{node.module}", *(f"{node.module}.{each.name}" for each in node.names)]
        yield module


def _texts(node: ast.AST, values: Values, depth: int = 0) -> Iterator[str]:
    """What a string may be, with * for what is not known."""
    inner = partial(_texts, values=values, depth=depth + 1)
    match node:
        case ast.Constant(value=str() as text):
            yield text
        case ast.JoinedStr(values=parts):
            yield from map("".join, itertools.product(*(list(inner(p)) or ["*"] for p in parts)))
        case ast.FormattedValue(value=value) | ast.Subscript(value=value) | ast.ListComp(elt=value):
            yield from inner(value)
        case ast.Tuple(elts=several) | ast.List(elts=several):
            yield from itertools.chain.from_iterable(map(inner, several))
        case ast.IfExp(body=one, orelse=other):
            yield from itertools.chain(inner(one), inner(other))
        case ast.Name(id=name) if depth < 4:
            yield from itertools.chain.from_iterable(map(inner, values.get(name, [])))


def _bound(target: ast.expr, value: ast.expr | None) -> Iterator[tuple[str, list[ast.expr]]]:
    """Variables of a target and what they are set to; None is not known."""
    if isinstance(target, ast.Name):
        yield target.id, [] if value is None else [value]
    elif isinstance(target, ast.Tuple):
        known = isinstance(value, ast.Tuple) and len(value.elts) == len(target.elts)
        parts = value.elts if known else [None] * len(target.elts)  # type: ignore[union-attr]
        for one, part in zip(target.elts, parts, strict=True):
            yield from _bound(one, part)


def _assigned(nodes: Iterable[ast.AST]) -> Values:
    """Variables that are set in some of the nodes, and to what."""
    values: Values = {}
    for node in nodes:
        if isinstance(node, ast.Assign):
            for name, found in _bound(node.targets[0], node.value):
                values.setdefault(name, []).extend(found)
    return values


def _named(node: ast.AST, values: Values) -> Iterator[str]:
    """Names of the figures that are made below ``node``."""
    match node:
        case ast.Module(body=body):
            values = _assigned(body)
        case ast.FunctionDef():
            values = {**values, **_assigned(ast.walk(node))}
        case ast.For(target=target, iter=ast.Tuple(elts=rows)):
            looped: Values = {}
            for name, found in (pair for row in rows for pair in _bound(target, row)):
                looped.setdefault(name, []).extend(found)
            values = {**values, **looped}
        case ast.For(target=target):
            values = {**values, **dict(_bound(target, None))}
        case ast.Call(func=ast.Name(id="Figure" | "measured"), args=[name, *_]):
            yield from _texts(name, values)
        case ast.Call(func=ast.Name(id="ratio_figures"), args=[name, *_]):
            yield from (f"{text}: *" for text in _texts(name, values))
        case ast.Call(func=ast.Name(id="replace"), keywords=keywords):
            for keyword in keywords:
                if keyword.arg == "name":
                    yield from _texts(keyword.value, values)
    for child in ast.iter_child_nodes(node):
        yield from _named(child, values)


def figure_names(system: str) -> set[str]:
    """Names of the figures that a bench can give, with * for what is filled in."""
    found = {name for module in _modules(system) for name in _named(module, {})}
    return {name for name in found if name.strip("*: ")}


def explained(system: str) -> list[str]:
    """Names in the first column of the tables of a system in docs/bench.md, with * for <...>."""
    text = (DOCS / "bench.md").read_text(encoding="utf-8")
    section = re.search(rf"^## `locatk bench {system}`\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    assert section, f"docs/bench.md tells nothing of {system}"
    rows = re.findall(r"^\| (`.*?`) \|", section[1], re.M)
    return [re.sub(r"<.*?>", "*", name) for row in rows for name in re.findall(r"`(.*?)`", row)]


def same(one: str, other: str) -> bool:
    """Whether two names with * can be the same."""
    return fnmatchcase(one, other) or fnmatchcase(other, one)


@pytest.mark.slow
@pytest.mark.parametrize("system", BENCHES)
def test_each_figure_is_explained(system: str) -> None:
    told, given = explained(system), figure_names(system)
    unknown = {name for name in given if not any(same(name, one) for one in told)}
    assert not unknown, f"docs/bench.md does not tell what {sorted(unknown)} are"
    gone = {one for one in told if not any(same(name, one) for name in given)}
    assert not gone, f"docs/bench.md tells of {sorted(gone)}, which locatk bench does not give"


def test_papers_name_figures_of_the_bench() -> None:
    """Names with a colon in docs/papers.md are rows that docs/bench.md explains."""
    told = [name for system in BENCHES for name in explained(system)]
    text = (DOCS / "papers.md").read_text(encoding="utf-8")
    spans = {re.sub(r"<.*?>", "*", span) for span in re.findall(r"`([^`\n]+)`", text)}
    named = {span for span in spans if ": " in span}
    assert len(named) > 50
    unknown = {name for name in named if not any(same(name, one) for one in told)}
    assert not unknown, f"docs/papers.md names rows that no bench has: {sorted(unknown)}"


def test_names_of_figures_are_found() -> None:
    """The test above must see what there is: names with what a function says of their parts."""
    body = """
CONSTANT = "of the module"

def rows(label, numbers):
    which, how = "one pass", "told"
    for kind, value in (("mean", 1.0), ("p95", 2.0)):
        yield Figure(f"{which}: {kind}", value, how)
    for n in numbers:
        yield Figure(f"{label} of {n}", n, "unit")
    name = f"{label} made" if numbers else "nothing"
    yield measured(name, "s", "call()")
    yield Figure(CONSTANT, 1.0, "unit")
    yield replace(row, name="another")
"""
    names = {"one pass: mean", "one pass: p95", "* of *", "* made", "nothing", "another"}
    names.add("of the module")
    assert set(_named(ast.parse(body), {})) == names
    assert {"kill -9: longest loss", "lines decoded"} <= figure_names("capture")
