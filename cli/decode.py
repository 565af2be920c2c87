"""``locatk decode``: decode the raw bytes of a recording again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.capture.options import columns_option
from locatk.cli.command import Command


@click.command(cls=Command, short_help="Decode the raw bytes of a recording again.")
@options.input_argument("recording")
@click.option(
    "--device",
    metavar="NAME",
    help="Device that sent the bytes, as in `locatk capture`; auto identifies it.  "
    "[default: that of the recording]",
)
@options.output("Session to write (.mcap).", endings=(".mcap",))
@options.input_option(
    "--artifact",
    many=True,
    help="Artifact to attach instead of those of the recording: a .toml file, or a session that "
    "contains artifacts (.mcap). Repeatable.",
)
@columns_option
@options.overwrite
@options.as_json
@options.verbosity
def command(
    recording: Path,
    device: str | None,
    output: Path,
    artifact: tuple[Path, ...],
    columns: tuple[str, ...],
    overwrite: bool,
    as_json: bool,
) -> None:
    """Decode the raw bytes of RECORDING again, and write them as a session.

    Use it if the recording was made with the wrong --device, if the decoder has improved, or to
    attach an artifact. The recorded times are kept.

    The exit status is 3 if frames are bad or missing.

    \b
    Examples:
      locatk decode run.mcap -o again.mcap
      locatk decode run.mcap --device lines --columns t_ms,x_m,y_m -o again.mcap
      locatk decode run.mcap --artifact tag.toml -o again.mcap
    """
    from locatk.formats.capture.attachments import attachments
    from locatk.formats.capture.redecoding import decode, losses
    from locatk.formats.devices import find_device
    from locatk.formats.devices.interface import Options

    if device not in (None, "auto"):
        find_device(device)
    options.guard_output(output, overwrite=overwrite, inputs=[recording, *artifact])
    with console.working("Decoding"):
        decoded = decode(
            recording,
            output,
            device=device,
            options=Options(columns=columns),
            artifacts=attachments(artifact),
            overwrite=overwrite,
        )
    for remark in decoded.remarks:
        console.warn(remark)
    rows: list[tuple[Any, ...]] = [
        (name, decoded.devices[name], t.bytes, t.frames, t.bad, t.lost, sum(t.samples.values()))
        for name, t in decoded.totals.items()
    ]
    header = ("name", "device", "bytes", "frames", "bad", "missing", "records")
    console.result(f"Wrote {output}\n" + console.table(header, rows))
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "system": decoded.system or None,
                "devices": [
                    {"name": name, "device": decoded.devices[name], **_decoder_counts(totals)}
                    for name, totals in decoded.totals.items()
                ],
                "remarks": decoded.remarks,
            }
        )
    if lost := losses(decoded):
        raise failures.Incomplete("; ".join(lost))


def _decoder_counts(totals: Any) -> dict[str, Any]:
    """Return the counts of the decoder, without those of the port."""
    from locatk.formats.capture.redecoding import LINE_STATISTICS

    return {key: value for key, value in vars(totals).items() if key not in LINE_STATISTICS}
