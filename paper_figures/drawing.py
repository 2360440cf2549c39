"""Runs the scripts of figures, all in one style, and saves what they draw."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from dlobench.errors import RunError, UsageError

HERE = Path(__file__).parent
STYLE = HERE / "style.mplstyle"
CHARACTERS = 19  # of a footnote that an inch holds


def laid_out(figure: Figure, note: str) -> None:
    """Adds a footnote and settles where everything is, so that lengths on the paper can be asked for."""
    note = textwrap.fill(note, int(CHARACTERS * figure.get_figwidth()))
    figure.supxlabel(note, fontsize=6.5, color="0.3", x=0.01, ha="left")
    figure.draw_without_rendering()
    figure.set_layout_engine("none")


def save(figure: Figure, name: str, out: Path, note: str = "") -> None:
    """Writes a figure as PDF and PNG, laid out once for both; without a note it is laid out already."""
    out.mkdir(parents=True, exist_ok=True)
    if note:
        laid_out(figure, note)
    figure.savefig(out / f"{name}.pdf", metadata={"CreationDate": None})
    figure.savefig(out / f"{name}.png")


def main(draw: Callable[[Path, Path], None], arguments: Sequence[str] | None = None) -> int:
    """Runs a script that draws from a results folder into another; returns 1, or 2, and says why where it cannot."""
    parser = argparse.ArgumentParser(description=sys.modules[draw.__module__].__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "out", help="folder of the figures")
    parser.add_argument("--results", type=Path, default=HERE.parent / "leaderboard" / "results", help="records")
    options = parser.parse_args(arguments)
    try:
        with mpl.rc_context(fname=STYLE):
            draw(options.results, options.out)
    except (RunError, UsageError, OSError) as error:
        print(f"{Path(sys.modules[draw.__module__].__file__ or '').name}: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, RunError | UsageError) else 1
    return 0
