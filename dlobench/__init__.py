"""Benchmarks models of deformable-object dynamics: worlds, data, protocols, models, a leaderboard."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dlobench.data.reading import load

__version__ = "0.1.0"
__all__ = ["load"]


def __getattr__(name: str) -> Any:
    """Imports `load` when it is asked for, so that `import dlobench` is instant."""
    if name == "load":
        from dlobench.data.reading import load  # noqa: PLC0415

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
