"""Writes the board's top into the README: `python leaderboard/top.py`, which `make leaderboard` does."""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

from dlobench.data.store import atomic_write
from dlobench.errors import RunError

HERE = Path(__file__).parent
README = HERE.parent / "README.md"
BEGIN, END = "<!-- --8<-- [start:board] -->\n", "<!-- --8<-- [end:board] -->\n"
ROWS = 5
K = "10"
CLOCK = "max_minutes"  # in the settings of a configuration whose fits the clock ended
SCALES = ("paper", "small", "mini")  # the largest that there is


def table(board: Path) -> str:
    """Returns the first models of `meta` at K = 10, at the largest scale on the board, as Markdown; in mm and cm².

    Raises `RunError` for what is no board, or one without such rows.
    """
    try:
        with board.open(newline="") as file:
            every = list(csv.DictReader(file, strict=True))
        if any(None in row or None in row.values() for row in every):
            raise ValueError("a row is cut")
        rows = [row for row in every if row["task"] == "meta" and row["K"] == K and row["place"]]
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise RunError(f"{board} is no board ({error}); `dlobench leaderboard build` writes it") from error
    if not rows:
        raise RunError(f"{board} has no row of meta at K = {K}; `dlobench leaderboard build` writes it")
    scale = next(each for each in SCALES if any(row["scale"] == each for row in rows))
    found = sorted((row for row in rows if row["scale"] == scale), key=lambda row: int(row["place"]))
    cell = found[0]["cell"]
    lines = [
        f"`{cell}` at scale `{scale}`: {found[0]['domains']} unseen domains, K = {K} trajectories to adapt on, "
        f"{found[0]['horizon']} pushes ahead.\n",
        "| place | model | seeds | skill (95 %) | error, mm | MSE, cm² |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    # Of several configurations the best, of those that no clock ended where there are any, as in figures
    chosen = sorted((row for row in found if row["cell"] == cell), key=lambda row: CLOCK in row["settings"])
    best = {row["model"]: row for row in reversed(chosen)}
    for row in sorted(best.values(), key=found.index)[:ROWS]:
        skill, low, high = (f"{float(row[name]):.3f}" for name in ("skill", "skill_low", "skill_high"))
        distance, mse = f"{1e3 * float(row['euclidean_m']):.1f}", f"{1e4 * float(row['mse_m2']):.2f}"
        lines.append(
            f"| {row['place']} | `{row['model']}` | {row['seeds']} | {skill} ({low}–{high}) | {distance} | {mse} |"
        )
    return "\n".join(lines) + "\n"


def written(readme: str, board: Path) -> str:
    """Returns the README with the table between its two marks; raises `RunError` where one is missing."""
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise RunError(f"the README lacks the mark {(END if begin else BEGIN).strip()}")
    return before + BEGIN + table(board) + END + after


def main() -> int:
    """Writes the table into the README, which stays as it is where that cannot be done."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    try:
        atomic_write(README, written(README.read_text(), HERE / "leaderboard.csv").encode())
    except RunError as error:
        print(f"top.py: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
