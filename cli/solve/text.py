"""Results of ``locatk solve`` for one session, as a JSON object and as text."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from locatk.cli import console
from locatk.cli.solve import detections_text as seen

if TYPE_CHECKING:
    from locatk.cli.systems import Solved


def entry(session: str | Path, output: str | Path, solved: Solved) -> dict[str, Any]:
    """Return the object of one session in ``--json`` (docs/commands.md)."""
    from locatk.core.solution import to_json

    solution = solved.solution
    return {
        "session": session,
        "system": solution.system,
        "method": solution.method,
        "output": output,
        "poses": solution.poses,
        "rejected": solution.rejected,
        "solve_s": solved.solve_s,
        "detections": to_json(solution.detections),
        **({"facts": to_json(solution.facts) or {}} if solution.system == "landmarks" else {}),
    }


def text(session: str | Path, output: str | Path, solved: Solved) -> str:
    """Format one session as text: a line, a table of devices, and the rejected observations."""
    solution = solved.solution
    # A scene that nothing measured has no metres.
    unit = "1e-3" if getattr(solution.artifact, "scale", None) == "unit" else "mm"
    sigmas = [f"sigma {axis} [{unit}]" for axis in "xyz"]
    header = ("device", "poses", *sigmas, "sigma heading [deg]")
    rows = [(t.device, len(t), *_spread(t.sigma)) for t in solution.trajectories]
    rejected = ", ".join(
        f"{count} {reason.replace('_', ' ')}" for reason, count in solution.rejected.items()
    )
    saw = seen.seen(solution)
    took = "solved before" if math.isnan(solved.solve_s) else f"{solved.solve_s:.3g} s"
    return "\n".join(
        [
            f"{session} -> {output}: {solution.poses} poses, {solution.system} by "
            f"{solution.method}, {took}",
            *([saw] if saw else []),
            *([console.table(header, rows)] if rows else []),
            f"rejected: {rejected or 'nothing'}",
        ]
    )


def notes(session: str | Path, solved: Solved) -> list[str]:
    """Return the remarks that a user of the poses needs; with ``--json`` too, on stderr."""
    return [f"{Path(session).name}: {each.message}" for each in solved.solution.warnings]


def _spread(sigma: Any) -> list[str]:
    """Return median standard deviations: x, y, z in mm and heading in degrees, `-` if unknown."""
    import numpy as np

    in_units = sigma[:, [0, 1, 2, 5]] * [1e3, 1e3, 1e3, 180 / np.pi]
    known = [column[np.isfinite(column)] for column in in_units.T]
    # Of lighthouse these are millimetres, of dots a thousandth of that.
    return [f"{np.median(column):#.3g}" if len(column) else "-" for column in known]
