"""Opens what MuJoCo draws on, screen or no screen, and says in one sentence what is missing where it cannot."""

from __future__ import annotations

import ctypes
import importlib
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

from dlobench.errors import RunError

if TYPE_CHECKING:
    import mujoco

VARIABLE = "MUJOCO_GL"  # MuJoCo's own: egl, osmesa or glfw
# What each way without a screen stands on: libraries, and Debian's packages that bring them and a driver in software.
_NEEDS = {
    "egl": (("libEGL.so.1", "libGL.so.1"), "libegl1 libgl1"),
    "osmesa": (("libOSMesa.so.8",), "libosmesa6"),
}


@cache
def load() -> None:
    """Imports MuJoCo bound to OpenGL: by what MUJOCO_GL says, and where it says nothing, on Linux, by EGL.

    MuJoCo chooses when it is first imported, and takes a screen for granted. So the choice is made again here, which
    works before and after that import, and leaves those who only simulate independent of EGL.
    Raises `RunError` naming the missing library and the package that brings it.
    """
    asked, chosen = os.environ.get(VARIABLE, ""), _chosen()
    try:
        from mujoco.rendering.classic import gl_context

        if chosen and not asked:
            os.environ[VARIABLE] = chosen
            try:
                importlib.reload(gl_context)
            finally:
                del os.environ[VARIABLE]  # as it was; dm_control takes an empty one for a screen
    except Exception as error:  # PyOpenGL raises AttributeError for a library that is not there
        raise RunError(_why(chosen, error)) from error


@contextmanager
def renderer(model: mujoco.MjModel, width: int, height: int) -> Iterator[mujoco.Renderer]:
    """Opens a renderer of a model for pictures of so many pixels. Raises `RunError` as `load` does."""
    load()
    import mujoco

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns that there is no screen; the error says it
            out = mujoco.Renderer(model, height, width)
    except Exception as error:
        raise RunError(_why(_chosen(), error)) from error
    with out:
        yield out


def _chosen() -> str:
    """Returns the way to OpenGL that is taken; "" is MuJoCo's own choice."""
    return os.environ.get(VARIABLE, "").strip().lower() or ("egl" if sys.platform == "linux" else "")


def _why(chosen: str, error: Exception) -> str:
    """Returns the sentence that says why nothing can be drawn."""
    reason = str(error).split(". ")[0].rstrip(".")
    if chosen not in _NEEDS:
        choices = f"there are: {', '.join(_NEEDS)} and, with a screen, glfw"
        return f"MuJoCo cannot draw by {VARIABLE}={chosen} ({reason}); {choices}"
    libraries, packages = _NEEDS[chosen]
    install = f"on Debian and Ubuntu `apt-get install {packages}`"
    for library in libraries:
        try:
            ctypes.CDLL(library)
        except OSError:
            return f"drawing by {chosen} needs the library {library}, which cannot be loaded; {install} brings it"
    return f"drawing by {chosen} failed ({reason}); where a driver is missing, {install} brings one"
