"""Turns drawn frames into the bytes of a file: one frame as PNG, many as GIF or MP4.

A film shows recorded states only, each for `HOLD` seconds: nothing is interpolated between them.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from fractions import Fraction
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench.errors import RunError, UsageError

Image = NDArray[np.uint8]  # (height, width, 3)  red, green, blue
Depth = NDArray[np.float32]  # (height, width)  m along the camera's axis; inf where there is nothing
Frame = Image | Depth

SUFFIXES = (".png", ".gif", ".mp4")
HOLD = Fraction(1, 4)  # s, of each state in a film
DEPTH_UNIT = 1e-4  # m, of a PNG's 16 bits; 65535 stands for 6.5535 m and more


def check_installed() -> None:
    """Sees that the packages of the extra `render` are there; raises `RunError` with the command that installs them."""
    _package("PIL.Image")
    _package("av")


def encode(frames: Sequence[Frame], suffix: str) -> bytes:
    """Encodes frames as a file of a kind: a `.png` takes one, a film as many as there are.

    A PNG holds depth as grey of 16 bits in units of 0.1 mm. In a film the nearest thing is white; the farthest, and
    where there is nothing, is black.
    Raises `UsageError` for another kind of file and `RunError` when a package is missing.
    """
    if suffix not in SUFFIXES:
        raise UsageError(f"unknown kind of picture {suffix!r}; there are: {', '.join(SUFFIXES)}")
    pixels: NDArray[Any] = np.stack(frames)
    if suffix == ".png":
        (pixel,) = pixels
        return _png(pixel if pixel.dtype == np.uint8 else _units(pixel))
    film = pixels if pixels.dtype == np.uint8 else _greys(pixels)
    return _gif(film) if suffix == ".gif" else _mp4(film)


def _units(depth: NDArray[Any]) -> NDArray[np.uint16]:
    """Returns a depth in units of 0.1 mm."""
    return np.minimum(np.rint(depth.astype(float) / DEPTH_UNIT), 65535).astype(np.uint16)


def _greys(depths: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns depths (T, height, width) as grey (T, height, width, 3), all on one scale."""
    things = depths[np.isfinite(depths)]
    near, far = (things.min(), things.max()) if things.size else (0.0, 1.0)
    share = np.clip((far - depths) / max(far - near, DEPTH_UNIT), 0, 1)  # nothing, at −inf, is clipped to black
    return np.repeat(np.rint(255 * share).astype(np.uint8)[..., None], 3, axis=-1)


def _png(pixels: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    _package("PIL.Image").fromarray(pixels).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def _gif(film: NDArray[np.uint8]) -> bytes:
    """Encodes a film that starts again when it has ended. States that look the same share one longer frame."""
    first, *others = (_package("PIL.Image").fromarray(frame) for frame in film)
    buffer = io.BytesIO()
    first.save(buffer, format="GIF", save_all=True, append_images=others, duration=int(1000 * HOLD), loop=0)
    return buffer.getvalue()


def _mp4(film: NDArray[np.uint8]) -> bytes:
    """Encodes a film as H.264, one frame a state; without mbtree, by which x264's bits vary from call to call."""
    av = _package("av")
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as out:
        stream = out.add_stream("h264", rate=1 / HOLD, options={"crf": "18", "x264-params": "mbtree=0"})
        stream.height, stream.width = film.shape[1:3]
        stream.pix_fmt = "yuv420p"  # what every player knows
        for frame in film:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        out.mux(stream.encode())
    return buffer.getvalue()


def _package(name: str) -> Any:
    """Imports a package of the extra `render` when it is needed."""
    try:
        return import_module(name)
    except ImportError as error:
        missing = f"writing pictures needs the package {error.name or name}"
        raise RunError(f"{missing}; `python -m pip install 'dlobench[render]'` brings it") from error
