"""What ``locatk tag design`` and ``tag check`` tell of a plan: for people and as JSON."""

from __future__ import annotations

import math
import textwrap
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.polaris.design.accuracy_bound import Bound
    from locatk.core.polaris.design.planning import Plan
    from locatk.core.polaris.tag import Tags

WIDTH = 60
"""Letters for the ids of a family."""


def text(plan: Plan) -> str:
    """The plan for people, in 100 columns."""
    return "\n\n".join(
        (
            _head(plan),
            console.table(("planned", "", "limit", "from"), _limits(plan)),
            console.table(
                ("one pass, at best", "along", "across", "angle"),
                (
                    _accuracy("magnet, speed known", plan.known_speed, False),
                    _accuracy("magnet, each step free", plan.free_speed, False),
                    _accuracy("tag, speed known", plan.known_speed, True),
                    _accuracy("tag, each step free", plan.free_speed, True),
                ),
            ),
            console.table(
                ("material", "count", "", "USD each"),
                (
                    (item.part, item.count, item.detail, item.price_usd and f"< {item.price_usd:g}")
                    for item in plan.materials
                ),
            ),
            "Accuracies are what noise alone permits: the published recordings come within 2 times "
            "of it\nin angle, 10 times in place. Prices: Polaris, sections 7.1 and 7.2.",
        )
    )


def entry(plan: Plan) -> dict[str, Any]:
    """The same for ``--json``: SI units, as each key says (docs/commands.md)."""
    result = asdict(plan)
    tags = result.pop("tags")
    del tags["built"], tags["site"], tags["notes"]
    use = result.pop("use")
    warnings, notes, materials = (result.pop(key) for key in ("warnings", "notes", "materials"))
    return {
        "tag": tags,
        "use": use,
        "plan": result,
        "materials": materials,
        "warnings": warnings,
        "notes": notes,
    }


def members(tags: Tags) -> str:
    """Which ids there are, in a few words."""
    if tags.ids is None:
        return "any id may occur"
    count = "1 id: " if len(tags.ids) == 1 else f"{len(tags.ids)} ids: "
    return count + textwrap.shorten(", ".join(map(str, tags.ids)), WIDTH, placeholder=" ...")


def _head(plan: Plan) -> str:
    tags, use, magnet = plan.tags, plan.use, plan.tags.magnet
    strength = " ".join(filter(None, (magnet.grade, f"({magnet.remanence_t:g} T)")))
    rows = (
        (
            "Tag",
            f"{tags.order} x {tags.order} grid of {_mm(tags.spacing_m)}, {tags.magnets} magnets, "
            f"{tags.orientations} orientations, codec {tags.codec}",
        ),
        (
            "Ids",
            f"{_short(plan.capacity)} ({math.log2(plan.capacity):.1f} bits); {members(tags)}",
        ),
        (
            "Magnet",
            f"{magnet.diameter_m * 1e3:g} x {_mm(magnet.height_m)} {strength}, "
            f"{magnet.moment * 1e3:.3g} mA m2, its middle {_mm(tags.clearance_m)} below "
            "the sensors",
        ),
        ("Array", f"{use.sensors} sensors {_mm(use.sensor_spacing_m)} apart, {use.settings}"),
    )
    return "\n".join(f"{name:<8}{what}" for name, what in rows)


def _limits(plan: Plan) -> list[tuple[str, str, str, str]]:
    """Name, value, limit and where the limit is from."""
    from locatk.core.polaris.design.planning import EARTH_T, FEWEST_SAMPLES, WEAKEST

    tags, use = plan.tags, plan.use
    noise = ", ".join(f"{value * 1e6:.3g}" for value in plan.noise_t)
    misled = (
        "peaks merge"
        if math.isnan(plan.neighbour_angle_rad)
        else f"{math.degrees(plan.neighbour_angle_rad):.1f} deg, {_mm(plan.neighbour_shift_m)}"
    )
    return [
        (
            "field above a magnet",
            _ut(plan.peak_t),
            f"at most {_ut(plan.range_t - EARTH_T)}",
            "range less the Earth's field",
        ),
        ("field midway between sensors", _ut(plan.between_t), "", ""),
        ("noise x, y, z", f"{noise} uT", "", plan.noise_from),
        (
            "signal to noise, above, midway",
            f"{plan.signal_to_noise:.0f}, {plan.between_to_noise:.0f}",
            f"at least {WEAKEST:g}",
            "midway",
        ),
        (
            "spacing of the magnets",
            _mm(tags.spacing_m),
            f"at least {_mm(plan.compact_spacing_m)}",
            f"`paper`: 0.8 of {_mm(plan.min_spacing_m)}",
        ),
        ("error if neighbours are ignored", misled, "", "at worst; `joint` does not"),
        (
            "sampling rate",
            f"{plan.rate_hz:.1f} Hz",
            f"at most {plan.max_rate_hz:.1f} Hz",
            f"{use.settings.conversion_s * 1e3:.2f} ms a conversion",
        ),
        ("speed", f"{use.speed_mps:g} m/s", f"at most {plan.max_speed_mps:.2g} m/s", "samples"),
        (
            "samples over a magnet's field",
            f"{plan.samples:.1f}",
            f"at least {FEWEST_SAMPLES:g}",
            f"{_mm(plan.step_m)} each, over {_mm(plan.half_across_m)}",
        ),
        (
            "orientations",
            str(tags.orientations),
            f"at most {plan.max_orientations}",
            f"laid to {math.degrees(plan.placement_rad):.2g} deg rms",
        ),
        ("tags with a misread magnet", _percent(plan.misread), "", "more than half a step off"),
        (
            "width of the tag, at 45 deg",
            f"{_mm(plan.tag_m)}, {_mm(plan.diagonal_m)}",
            f"at most {_mm(plan.array_m)}",
            f"array; play {_mm(plan.play_m)} a side",
        ),
    ]


def _accuracy(name: str, bound: Bound, pose: bool) -> tuple[str, ...]:
    along, across, angle = (
        (bound.pose_x_m, bound.pose_y_m, bound.pose_heading_rad)
        if pose
        else (bound.x_m, bound.y_m, bound.angle_rad)
    )
    if math.isnan(along):
        return name, "-", "-", "-"
    return name, f"{along * 1e3:.4f} mm", f"{across * 1e3:.4f} mm", f"{math.degrees(angle):.3f} deg"


def _short(number: int) -> str:
    return str(number) if number < 10**15 else f"about 10^{math.log10(number):.0f}"


def _percent(part: float) -> str:
    return f"{part:.0%}".replace("%", " %") if part > 0.1 else f"{part * 100:.2g} %"


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.3g} mm"


def _ut(tesla: float) -> str:
    return f"{tesla * 1e6:.4g} uT" if tesla >= 1e-3 else f"{tesla * 1e6:.3g} uT"
