"""Hot loops in C; an install without a compiler has no such module (core/_kernels.c)."""

from typing_extensions import Buffer

def find_dots(
    images: Buffer,
    n: int,
    h: int,
    w: int,
    taps: Buffer,
    block: int,
    reach: int,
    faintest: float,
    share: float,
    most: int,
    xy: Buffer,
    counts: Buffer,
    /,
) -> None: ...
def fit_lattices(
    points: Buffer,
    valid: Buffer,
    n: int,
    m: int,
    lens: bool,
    ring: Buffer,
    prior: Buffer,
    seeds: int,
    fewest: int,
    nearest: float,
    farthest: float,
    gate: float,
    loose: float,
    tight: float,
    firm: float,
    bent_from: float,
    offset: float,
    parameters: Buffer,
    uv: Buffer,
    place: Buffer,
    sigma: Buffer,
    found: Buffer,
    /,
) -> None: ...
