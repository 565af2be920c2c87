"""Decoding of image files, and grey values of frames."""

from __future__ import annotations

import contextlib
import io

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.formats import images


def noise(shape: tuple[int, ...] = (120, 188), kind: type = np.uint8, seed: int = 7) -> np.ndarray:
    """Return pixels of random values."""
    rng = np.random.default_rng(seed)
    return rng.integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)


@given(st.integers(1, 16), st.integers(0, 2**32 - 1))
def test_sixteen_bits_keep_the_contrast_of_any_camera(bits: int, seed: int) -> None:
    deep = np.random.default_rng(seed).integers(0, 1 << bits, (20, 30), np.uint16)
    deep[0, 0] = (1 << bits) - 1
    grey = images.grey(deep)
    shift = max(0, bits - 8)
    np.testing.assert_array_equal(grey, deep >> shift)
    assert grey.dtype == np.uint8
    assert grey.max() == (255 if bits >= 8 else (1 << bits) - 1)


KINDS = (".png", ".jpg", ".webp", ".bmp", ".pgm", ".tiff")


@pytest.mark.parametrize("extension", KINDS)
def test_grey_files_read_as_opencv_reads_them(extension: str) -> None:
    picture = noise()
    data = cv2.imencode(extension, cv2.GaussianBlur(picture, (0, 0), 2))[1]
    theirs = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    ours = images.grey(images.decode(data.tobytes()).pixels)
    assert np.abs(ours.astype(int) - theirs).max() <= (0 if extension != ".webp" else 1)
    lossy = extension in (".jpg", ".webp")
    assert images.decode(data.tobytes()).format == {".png": "png", ".jpg": "jpeg"}.get(
        extension, "webp" if lossy else ""
    )


@pytest.mark.parametrize("extension", [".png", ".bmp", ".ppm", ".tiff", ".jpg"])
def test_colour_becomes_luminance(extension: str) -> None:
    picture = cv2.GaussianBlur(noise((120, 188, 3)), (0, 0), 2)
    data = cv2.imencode(extension, picture)[1]
    theirs = cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2GRAY)
    ours = images.grey(images.decode(data.tobytes()).pixels)
    assert np.abs(ours.astype(int) - theirs).max() <= 1


@pytest.mark.parametrize("extension", [".png", ".tiff"])
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_transparent_pixels_are_blended_with_white(extension: str, depth: type) -> None:
    top = np.iinfo(depth).max
    picture = np.zeros((2, 3, 4), depth)
    picture[0, :, 3] = [0, top // 2, top]
    picture[1] = top
    data = cv2.imencode(extension, picture)[1].tobytes()
    grey = images.grey(images.decode(data).pixels)
    assert np.abs(grey.astype(int) - [[255, 128, 0], [255, 255, 255]]).max() <= 1


@pytest.mark.parametrize("extension", [".png", ".pgm", ".tiff"])
def test_sixteen_bit_files_keep_their_bits(extension: str) -> None:
    deep = (noise(kind=np.uint16) >> 4) | 0x800  # 12 bits
    data = cv2.imencode(extension, deep)[1].tobytes()
    pixels = images.decode(data).pixels
    np.testing.assert_array_equal(pixels, deep)
    np.testing.assert_array_equal(images.grey(pixels), deep >> 4)


def test_twelve_bits_of_colour_are_kept() -> None:
    """In 16 bits they are almost black; the upper 8 bits alone would leave 16 greys."""
    deep = noise((120, 188, 3), np.uint16) >> 4
    data = cv2.imencode(".png", deep)[1].tobytes()
    theirs = cv2.cvtColor(deep, cv2.COLOR_BGR2GRAY) >> 4
    assert np.abs(images.grey(images.decode(data).pixels).astype(int) - theirs).max() <= 1


def test_one_bit_per_pixel() -> None:
    from PIL import Image

    bits = noise() > 127
    for kind in ("PNG", "PPM", "TIFF"):
        stream = io.BytesIO()
        Image.fromarray(bits).save(stream, kind)
        grey = images.grey(images.decode(stream.getvalue()).pixels)
        np.testing.assert_array_equal(grey, np.where(bits, 255, 0))


@pytest.mark.parametrize("extension", KINDS)
def test_truncated_image_files_are_errors(extension: str) -> None:
    picture = noise((40, 60))
    data = cv2.imencode(extension, picture)[1].tobytes()
    whole = images.grey(images.decode(data).pixels)
    for length in [*range(0, len(data), 37), len(data) - 20, len(data) - 1]:
        # What is missing may be an end mark after the last pixel.
        with contextlib.suppress(InputError):
            np.testing.assert_array_equal(images.grey(images.decode(data[:length]).pixels), whole)


@given(st.binary(max_size=200))
def test_anything_is_an_image_or_an_error(data: bytes) -> None:
    with pytest.raises(InputError):
        images.decode(b"\x89PNG\r\n\x1a\n" + data)
    with pytest.raises(InputError):
        images.decode(b"BM" + data)


def test_pictures_that_are_no_single_frame() -> None:
    from PIL import Image

    pages = [Image.fromarray(noise((8, 9), seed=seed)) for seed in range(3)]
    stream = io.BytesIO()
    pages[0].save(stream, "TIFF", save_all=True, append_images=pages[1:])
    with pytest.raises(InputError, match="3 pictures"):
        images.decode(stream.getvalue())
    stream = io.BytesIO()
    Image.fromarray(np.ones((4, 5), np.float32)).save(stream, "TIFF")
    with pytest.raises(InputError, match="floating-point"):
        images.decode(stream.getvalue())


@pytest.mark.parametrize(
    ("encoding", "code"),
    [
        ("rgb8", cv2.COLOR_RGB2GRAY),
        ("bgr8", cv2.COLOR_BGR2GRAY),
        ("bgra8", cv2.COLOR_BGRA2GRAY),
        ("rgba8", cv2.COLOR_RGBA2GRAY),
    ],
)
def test_raw_colour_of_other_tools(encoding: str, code: int) -> None:
    pixels = noise((6, 7, 4 if "a" in encoding else 3))
    if "a" in encoding:
        pixels[..., 3] = 255
    rows = np.pad(pixels.reshape(6, -1), ((0, 0), (0, 5)))  # rows may be longer than pixels
    grey = images.raw_grey(rows.tobytes(), 7, 6, rows.shape[1], encoding)
    assert np.abs(grey.astype(int) - cv2.cvtColor(pixels, code)).max() <= 1
