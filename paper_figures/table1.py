"""Writes Table 1: the error on unseen domains by the trajectories adapted on, beside the paper's four numbers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from drawing import main
from recorded import USUAL_N, Recorded, adapting, label, markdown, read, shown

from dlobench.bench.statistics import Interval

CM2 = 1e4  # 10⁻⁴ m², the paper's unit, in a square metre
# The paper prints four numbers twice in a row; this is the likeliest reading: multi-task, then MAML at K = 1, 10, 50
PAPER = {
    "the paper's multi-task and MAML, N = 5": {0: 1.54, 1: 1.45, 10: 1.17, 50: 1.08},
    "the paper's multi-task and MAML, N = 50": {0: 1.85, 1: 1.56, 10: 1.30, 50: 1.21},
}


def numbers(of: Recorded) -> dict[tuple[str, int, int], Interval]:
    """Returns the mean squared error, m², with its interval, by model, trajectories a training domain and K."""
    found = of.intervals("mse", ["trajectories", "K"])
    return {(name, int(trajectories), int(K)): one for (name, trajectories, K), one in found.items()}


def rows(of: Recorded) -> list[list[str]]:
    """Returns the table as text, the header first; what never adapts has one number, without adaptation."""
    found, adapt = numbers(of), adapting(of)
    privileged = {label(record) for record in of.records if record.privileged}
    columns = sorted({key[1:] for key in found})
    sizes = sorted({size for size, _ in columns})
    Ks = sorted({K for _, K in columns} | {K for row in PAPER.values() for K in row})
    columns = [(size, K) for size in sizes for K in Ks]

    def head(size: int, K: int) -> str:
        group = "" if len(sizes) == 1 else f"{size} trajectories, "
        return group + (f"K = {K}" if K else "no adaptation")

    def cell(name: str, size: int, K: int) -> str:
        one = found.get((name, size, K))
        return "–" if one is None or (K and name not in adapt) else shown(one, CM2)

    table = [["model", "seeds", *(head(*column) for column in columns)]]
    for name in of.names:
        seeds = of.frame.loc[of.frame["name"] == name, "seed"].nunique()
        called = name + (" (told the parameters)" if name in privileged else "")
        table.append([called, str(seeds), *(cell(name, *column) for column in columns)])
    for name, paper in PAPER.items():
        table.append([name, "", *(f"{paper[K]:.2f}" if K in paper else "–" for _, K in columns)])
    return table


def latex(table: Sequence[Sequence[str]], note: str) -> str:
    """Returns a table as LaTeX, for the package booktabs: the paper's rows stand below a rule."""

    def line(row: Sequence[str]) -> str:
        return " & ".join(cell.replace("_", r"\_").replace("–", "--").replace("%", r"\%") for cell in row) + r" \\"

    header, *body = table
    ours, papers = body[: -len(PAPER)], body[-len(PAPER) :]
    lines = [
        "% " + note,
        r"\begin{tabular}{ll" + "r" * (len(header) - 2) + "}",
        r"\toprule",
        line(header),
        r"\midrule",
        *map(line, ours),
        r"\midrule",
        *map(line, papers),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def draw(results: Path, out: Path) -> None:
    """Writes table1.md and table1.tex."""
    of = read(results, "meta")
    table = rows(of)
    sizes = ", ".join(map(str, sorted(of.frame["trajectories"].unique())))
    told = "".join(
        f"N of {name} is {N}, unless a row says otherwise. " for name, N in USUAL_N.items() if name in of.names
    )
    note = (
        f"Mean squared error of a coordinate 4 pushes ahead, 10⁻⁴ m²; {sizes} trajectories a training domain; "
        f"{of.footnote()}. Models with one number never adapt. {told}"
        "Of the paper only the order of its numbers is comparable: its simulator is another one."
    )
    markdown(out / "table1.md", table, note)
    (out / "table1.tex").write_text(latex(table, note))


if __name__ == "__main__":
    sys.exit(main(draw))
