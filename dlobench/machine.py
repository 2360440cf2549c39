"""Describes the machine and the versions that a result came from."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from dlobench import __version__

# Instruction sets that decide how floating-point kernels round; the bits of a trajectory may depend on them.
_SIMD = ("sse", "avx", "fma", "f16c", "amx", "neon", "sve", "asimd")
_PACKAGES = ("mujoco", "dm_control", "torch", "torchrl", "numpy", "pandas")


def cpu() -> dict[str, object]:
    """Returns the CPU's architecture, model name and SIMD flags."""
    model, flags = platform.processor(), set[str]()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                model = value.strip()
            elif key.strip() in ("flags", "Features"):
                flags = {flag for flag in value.split() if flag.startswith(_SIMD)}
    except OSError:
        pass  # not Linux: architecture and model must do
    return {"architecture": platform.machine(), "model": model, "simd": sorted(flags)}


def versions() -> dict[str, str]:
    """Returns the versions of Python, dlobench and the packages that results depend on, without importing them."""
    found = {"python": platform.python_version(), "dlobench": __version__}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "absent"
    return found
