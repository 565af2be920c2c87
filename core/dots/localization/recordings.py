"""Localization of all frames of a recording, and the causes of rejections that a setting removes.

Frames of one size are loaded and localized in batches. Of the frames in which no position was
found, a sample is tried again mirrored and inverted, and with the other codecs: a camera that
mirrors its images or a manifest of another codec explain most of the frames of a recording at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from locatk.core import progress
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import CODEC_NAMES, Codec, codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import (
    SECTION_BORDER,
    TOO_FEW_DOTS,
    LocalizedFrames,
    localize_frames,
    unlocalized_frames,
)
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError

Images = NDArray[np.uint8]
Localize = Callable[[Images, Codec, Camera | None], LocalizedFrames]

MAX_LOADED_PX = 6_000_000
"""Pixels of the frames of one size that are in memory at once."""

SHEET_SLACK_PITCHES = 12.0
"""Largest distance of the middle of a frame from the printed area whose dots it shows [pitches]."""

MAX_TRIED_FRAMES = 16
"""Number of rejected frames of a recording that are tried for another cause. A cause that concerns
a fifth of them is missed in 3 % of the recordings."""

UNREADABLE = "unreadable_frame"
OTHER_SIZE = "not_of_the_cameras_size"
OFF_SHEET = "off_sheet"

MIRRORED = "mirrored"
INVERTED = "inverted"
MIRRORED_AND_INVERTED = "mirrored_and_inverted"

RESTORATIONS: dict[str, Callable[[Images], Images]] = {
    MIRRORED: lambda images: images[:, :, ::-1],
    INVERTED: lambda images: 255 - images,
    MIRRORED_AND_INVERTED: lambda images: 255 - images[:, :, ::-1],
}
"""Functions that restore images as printed, by the reason for which frames are rejected."""

EXPLAINED = ("", UNREADABLE, OTHER_SIZE, OFF_SHEET, SECTION_BORDER)
"""Reasons that leave no other cause to look for; that of localized frames is empty."""


def localize_recording(
    frames: Frames,
    manifest: Manifest,
    code: Codec,
    camera: Camera | None,
    localize: Localize | None = None,
) -> LocalizedFrames:
    """Localize the frames of a camera on the grid, and reject those off the sheets.

    See :func:`localize_batch`. Mirrored and inverted frames are rejected with that reason.
    """
    result = unlocalized_frames(len(frames), TOO_FEW_DOTS)
    done = 0
    for indices, images in batches(frames, np.arange(len(frames)), result.rejected, camera):
        result.update(indices, localize_batch(images, manifest, code, camera, localize))
        done += len(indices)
        progress.report("frames", done, len(frames))
    _recognize_altered(frames, result.rejected, code, camera)
    return result


def localize_batch(
    images: Images,
    manifest: Manifest,
    code: Codec,
    camera: Camera | None,
    localize: Localize | None = None,
) -> LocalizedFrames:
    """Localize images (n, h, w) of a camera on the grid, and reject those off the sheets.

    The manifest names the codec ``code``, and a position on one of its sheets confirms it: the same
    window of another codec is elsewhere, by more than a million pitches. Off the sheets a window
    may be one of another codec, which limits the confidence. ``localize`` is another method than
    :func:`~locatk.core.dots.localization.frames.localize_frames`.
    """
    if localize is not None:
        part = localize(images, code, camera)
    else:
        part = localize_frames(images, code, camera, other_codec_odds=0)
    off_sheet = np.flatnonzero(part.accepted & (find_sheets(part, manifest) < 0))
    part.rejected[off_sheet] = OFF_SHEET
    if localize is None and len(off_sheet):
        uncertain = localize_frames(images[off_sheet], code, camera)
        part.confidence[off_sheet] = uncertain.confidence
    return part


def find_sheets(localized: LocalizedFrames, manifest: Manifest) -> NDArray[np.intp]:
    """Return the number of the sheet (n,) of each localized frame, -1 if it has none."""
    sheet = np.full(len(localized), -1, np.intp)
    accepted = np.flatnonzero(localized.accepted)
    sheet[accepted] = manifest.find(
        localized.grid[accepted], localized.section[accepted], slack=SHEET_SLACK_PITCHES
    )
    return sheet


def count_frames_of_other_codecs(
    frames: Frames, rejected: NDArray[np.object_], manifest: Manifest, camera: Camera | None
) -> tuple[Counter[str], Counter[str]]:
    """Count the frames that are evidence for and against other codecs, in samples.

    Returns
    -------
    located : Counter
        By codec, rejected frames that it locates on a sheet of the manifest.
    contradicted : Counter
        By codec of ``located``, localized frames that it does not locate on a sheet.
    """

    def count_located(sample: NDArray[np.intp], name: str) -> int:
        return sum(
            int((find_sheets(part, manifest) >= 0).sum())
            for _, images in batches(frames, sample, rejected.copy(), camera)
            for part in [localize_frames(images, codec(name), camera, other_codec_odds=0)]
        )

    unexplained = _sample(np.flatnonzero(~np.isin(rejected, EXPLAINED) | (rejected == OFF_SHEET)))
    localized = _sample(np.flatnonzero(rejected == ""))
    names = [name for name in CODEC_NAMES if name != manifest.codec]
    located = +Counter({name: count_located(unexplained, name) for name in names})
    contradicted = {name: len(localized) - count_located(localized, name) for name in located}
    return located, Counter(contradicted)


def _recognize_altered(
    frames: Frames, rejected: NDArray[np.object_], code: Codec, camera: Camera | None
) -> None:
    """Replace the reason of frames that are mirrored or inverted, if some of a sample are."""

    def localizable(restore: Callable[[Images], Images], indices: NDArray[np.intp]) -> list[int]:
        return [
            int(index)
            for batch, images in batches(frames, indices, rejected, camera)
            for index in batch[localize_frames(restore(images), code, camera).accepted]
        ]

    def altered(restore: Callable[[Images], Images]) -> list[int]:
        unexplained = np.flatnonzero(~np.isin(rejected, EXPLAINED))
        is_any = len(localizable(restore, _sample(unexplained))) > 0
        return localizable(restore, unexplained) if is_any else []

    for reason, restore in RESTORATIONS.items():
        rejected[altered(restore)] = reason


def _sample(indices: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return at most :data:`MAX_TRIED_FRAMES` of ``indices``, evenly spaced."""
    count = min(len(indices), MAX_TRIED_FRAMES)
    return indices[((np.arange(count) + 0.5) * len(indices) / max(count, 1)).astype(np.intp)]


def batches(
    frames: Frames,
    chosen: NDArray[np.intp],
    rejected: NDArray[np.object_],
    camera: Camera | None,
) -> Iterator[tuple[NDArray[np.intp], Images]]:
    """Yield indices and images of chosen frames of one size; store reasons in ``rejected``."""
    indices_by_shape: dict[tuple[int, ...], list[int]] = {}
    images: dict[int, Images] = {}
    for index in chosen.tolist():
        try:
            image = frames.images[index]
        except InputError:
            rejected[index] = UNREADABLE
            continue
        if camera is not None and image.shape != camera.size[::-1]:
            rejected[index] = OTHER_SIZE
            continue
        images[index] = image
        indices = indices_by_shape.setdefault(image.shape, [])
        indices.append(index)
        if len(indices) * image.size >= MAX_LOADED_PX:
            yield np.array(indices), np.stack([images.pop(k) for k in indices])
            indices.clear()
    for indices in filter(None, indices_by_shape.values()):
        yield np.array(indices), np.stack([images.pop(k) for k in indices])
