# SPDX-License-Identifier: MIT
"""An off-screen OpenGL context, from EGL or OSMesa, whichever works here."""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib
import os
from typing import Any

__all__ = ["NoRenderingError", "make_context", "rendering_backend"]

_PLATFORM_DEVICE = 0x313F  # EGL_PLATFORM_DEVICE_EXT
_PACKAGES = {"egl": "libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri", "osmesa": "libosmesa6 libgl1"}


class NoRenderingError(RuntimeError):
    """Neither EGL nor OSMesa can render here."""


def _egl_problem() -> str | None:
    """Why EGL cannot render without a display, or None if it can. Asked before PyOpenGL binds itself to a platform."""
    name = ctypes.util.find_library("EGL")
    if name is None:
        return "libEGL is not installed"
    try:
        egl = ctypes.CDLL(name)
    except OSError as error:
        return f"libEGL cannot be loaded ({error})"
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    query = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    get_display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query or not get_display:
        return "libEGL has no device platform"
    devices = (ctypes.c_void_p * 16)()
    count = ctypes.c_int()
    ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(query)(
        len(devices), ctypes.cast(devices, ctypes.c_void_p), ctypes.cast(ctypes.byref(count), ctypes.c_void_p)
    )
    display_of = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(get_display)
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    egl.eglInitialize.restype = ctypes.c_uint
    for device in devices[: count.value]:
        display = display_of(_PLATFORM_DEVICE, device, None)
        if display and egl.eglInitialize(display, None, None):
            return None
    return f"libEGL offers {count.value} devices and none of them can be used"


def _osmesa_problem() -> str | None:
    name = ctypes.util.find_library("OSMesa")
    return None if name else "libOSMesa is not installed"


_PROBLEMS = {"egl": _egl_problem, "osmesa": _osmesa_problem}
_chosen: str | None = None


def rendering_backend() -> str:
    """``"egl"`` or ``"osmesa"``: the first that works; the environment variable MUJOCO_GL limits the choice to one.

    Raises:
        NoRenderingError: neither works; the message names the packages to install.
    """
    global _chosen
    if _chosen is None:
        wanted = os.environ.get("MUJOCO_GL", "").lower()
        candidates = [wanted] if wanted in _PROBLEMS else list(_PROBLEMS)
        reasons = []
        for name in candidates:
            problem = _PROBLEMS[name]()
            if problem is None:
                _chosen = name
                return name
            reasons.append(f"{name}: {problem} (Debian: apt-get install {_PACKAGES[name]})")
        raise NoRenderingError("cannot render off-screen; " + "; ".join(reasons))
    return _chosen


def make_context(width: int, height: int) -> Any:
    """An off-screen OpenGL context, made current. It has ``make_current()`` and ``free()``.

    Raises:
        NoRenderingError: no backend works.
    """
    name = rendering_backend()
    os.environ.setdefault("PYOPENGL_PLATFORM", name)
    try:
        context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        context.make_current()
    except Exception as error:  # PyOpenGL raises AttributeError, ImportError, GLError, ... for a missing library
        raise NoRenderingError(
            f"off-screen rendering by {name} failed ({type(error).__name__}: {error}); "
            f"Debian: apt-get install {_PACKAGES[name]}"
        ) from error
    return context
