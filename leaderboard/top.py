"""Writes the board's top into the README: `python leaderboard/top.py`, which `make leaderboard` does."""

from __future__ import annotations

import csv
from pathlib import Path

HERE = Path(__file__).parent
README = HERE.parent / "README.md"
BEGIN, END = "<!-- --8<-- [start:board] -->\n", "<!-- --8<-- [end:board] -->\n"
ROWS = 5
K = "10"
SCALES = ("paper", "small", "mini")  # the largest that there is


def table(board: Path) -> str:
    """Returns the first rows of `meta` at K = 10, at the largest scale on the board, as Markdown; in mm and cm²."""
    with board.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["task"] == "meta" and row["K"] == K and row["place"]]
    scale = next(each for each in SCALES if any(row["scale"] == each for row in rows))
    found = sorted((row for row in rows if row["scale"] == scale), key=lambda row: int(row["place"]))
    cell = found[0]["cell"]
    lines = [
        f"`{cell}` at scale `{scale}`: {found[0]['domains']} unseen domains, K = {K} trajectories to adapt on, "
        f"{found[0]['horizon']} pushes ahead.\n",
        "| place | model | seeds | skill (95 %) | error, mm | MSE, cm² |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in [row for row in found if row["cell"] == cell][:ROWS]:
        skill, low, high = (f"{float(row[name]):.3f}" for name in ("skill", "skill_low", "skill_high"))
        error, mse = f"{1e3 * float(row['euclidean_m']):.1f}", f"{1e4 * float(row['mse_m2']):.2f}"
        lines.append(
            f"| {row['place']} | `{row['model']}` | {row['seeds']} | {skill} ({low}–{high}) | {error} | {mse} |"
        )
    return "\n".join(lines) + "\n"


def written(readme: str, board: Path) -> str:
    """Returns the README with the table between its two marks."""
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    return before + BEGIN + table(board) + END + after


if __name__ == "__main__":
    README.write_text(written(README.read_text(), HERE / "leaderboard.csv"))
