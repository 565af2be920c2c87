"""``locatk print tag``: templates for placing magnets by hand."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command

ENDINGS = {"pdf": (".pdf",), "svg": (".svg",)}


@click.command(cls=Command, short_help="Draw templates for placing a tag's magnets.")
@options.input_argument("tag_file")
@options.output("File to write.")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(list(ENDINGS)),
    help="`svg` writes one numbered file per page.  [default: by the ending of the output]",
)
@click.option(
    "--id",
    "ids",
    type=click.IntRange(0),
    multiple=True,
    metavar="N",
    help="Id of a tag to draw. Repeatable.  [default: all members of the family]",
)
@click.option(
    "--size",
    default="A4",
    show_default=True,
    metavar="PAPER",
    help="A0 to A5, Letter, Tabloid, or a size as in 600x900mm or 24x36in, rotated if that saves "
    "pages.",
)
@click.option(
    "--margin",
    "margin_mm",
    type=click.FloatRange(0),
    default=10.0,
    show_default=True,
    metavar="MM",
    help="Empty margin, for printers that cannot print to the edge.",
)
@click.option(
    "--mirror",
    is_flag=True,
    help="Mirror the tag, for magnets that are inserted from below.",
)
@options.overwrite
@options.as_json
@options.verbosity
def tag(
    tag_file: Path,
    output: Path,
    format_name: str | None,
    ids: tuple[int, ...],
    size: str,
    margin_mm: float,
    mirror: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Draw the tags of TAG_FILE at true size, as templates for placing their magnets.

    Each magnet has an outline and an arrow to its north pole, with the angle clockwise from the
    forward direction: mark the north pole on the rim of the disc, and align the mark with the
    arrow. A page contains as many tags as fit, each with cut marks. Print at 100 % and measure the
    rulers. Tags are drawn as designed, even if the file contains calibrated magnets.

    \b
    Examples:
      locatk print tag tag.toml -o tags.pdf
      locatk print tag tag.toml --id 262143 --id 5 -o tags.pdf --size Letter
      locatk print tag tag.toml --id 262143 -o tag.svg
      locatk print tag tag.toml --id 7 -o below.pdf --mirror
    """
    from locatk.core.paper_sizes import paper_size
    from locatk.core.polaris.drawing.cards import draw_tag_cards
    from locatk.formats.artifacts.tags import read_tags

    format_name = options.choose_format(output, format_name, ENDINGS)
    tags = read_tags(tag_file)
    _, paper_mm = paper_size(size)
    drawn = draw_tag_cards(
        tags,
        _layouts(tag_file, tags, ids),
        paper_mm,
        margin_mm=margin_mm,
        mirror=mirror,
    )
    files = _files(output, format_name, len(drawn.pages))
    for path in files:
        options.guard_output(path, overwrite=overwrite, inputs=[tag_file])
    _write(files, format_name, drawn, overwrite=overwrite)
    console.result(_text(files, drawn))
    console.say("Print at 100 %, without scaling to fit, and measure the rulers.")
    if as_json:
        console.emit_json(_entry(files, drawn))


def _layouts(tag_file: Path, tags: Any, ids: tuple[int, ...]) -> list[tuple[int, Any]]:
    """Return the tags to draw; refuse ids that the solver would not read."""
    from locatk.core.errors import InputError, error_context
    from locatk.core.polaris.codec import layout_of

    if not ids and tags.ids is None and not tags.site:
        raise click.UsageError(f"{tag_file} contains no family of ids; select tags by --id.")
    for number in ids:
        if tags.ids is not None and number not in tags.ids:
            raise InputError(
                f"id {number} is not in the family",
                file=tag_file,
                hint=f"The family has {len(tags.ids)} ids from {min(tags.ids)} to {max(tags.ids)}; "
                "without --id all are drawn",
            )
    wanted = ids or tags.ids or tuple(sorted(tags.site))
    with error_context(tag_file):
        return [(number, layout_of(tags, number)) for number in wanted]


def _files(output: Path, format_name: str, pages: int) -> list[Path]:
    """Return one file for a PDF and for a single page, else one for each page."""
    if format_name == "pdf" or pages == 1:
        return [output]
    digits = len(str(pages))
    return [output.with_stem(f"{output.stem}-{n:0{digits}}") for n in range(1, pages + 1)]


def _write(files: Sequence[Path], format_name: str, drawn: Any, *, overwrite: bool) -> None:
    """Write all files completely before the first one appears."""
    from locatk.formats.output import atomic_write
    from locatk.formats.printing.drawings import render_pages, render_svg

    ids = {item.tag_id for item in drawn.tags}
    title = f"locatk tag {min(ids)}" if len(ids) == 1 else f"locatk, {len(ids)} tags"
    if format_name == "pdf":
        hint = "Use a smaller paper, or --format svg"
        contents = [render_pages(drawn.pages, title, hint=hint)]
    else:
        contents = [render_svg(page, title) for page in drawn.pages]
    with contextlib.ExitStack() as stack:
        for path, data in zip(files, contents, strict=True):
            stack.enter_context(atomic_write(path, overwrite=overwrite)).write(data)


def _text(files: Sequence[Path], drawn: Any) -> str:
    """Format the summary of the drawn tags."""
    count, pages = len(drawn.tags), len(drawn.pages)
    names = str(files[0]) if len(files) == 1 else f"{files[0]} to {files[-1].name}"
    width, height = drawn.pages[0].size_mm
    return (
        f"Wrote {names}: {count} tag{'s' * (count > 1)} on {pages} page{'s' * (pages > 1)} of "
        f"{width:g} x {height:g} mm"
    )


def _entry(files: Sequence[Path], drawn: Any) -> dict[str, Any]:
    """Return the summary for ``--json`` (docs/commands.md)."""
    return {
        "version": 1,
        "outputs": list(files),
        "page_mm": drawn.pages[0].size_mm,
        "tags": [
            {"id": item.tag_id, "page": item.page + 1, "origin_mm": item.origin_mm}
            for item in drawn.tags
        ],
    }
