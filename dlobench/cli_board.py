"""Speaks the verb `dlobench leaderboard build`, and prints rows of a leaderboard."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dlobench.errors import UsageError

COMMITTED_RESULTS = Path("leaderboard/results")
COMMITTED_BOARD = Path("leaderboard/leaderboard.csv")

leaderboard_app = typer.Typer(help="Build the leaderboard.", no_args_is_help=True)


@leaderboard_app.command("build")
def leaderboard_build(
    results: Annotated[Path | None, typer.Option(help=f"Folder of records. Default: {COMMITTED_RESULTS}.")] = None,
    out: Annotated[Path | None, typer.Option(help="CSV to write. Default: leaderboard.csv beside the records.")] = None,
    page: Annotated[bool, typer.Option(help="Also write index.html beside the CSV.")] = True,
) -> None:
    """Build the leaderboard and its page from the records. The same records give the same bytes."""
    from dlobench.bench import leaderboard
    from dlobench.bench.results import read_all
    from dlobench.bench.scores import scores

    if out is not None and (out.suffix != ".csv" or (results in out.parents and out.parent != results)):
        raise UsageError(f"--out {str(out)!r} is not a .csv file, or lies among the records")
    records = read_all(results or COMMITTED_RESULTS)
    tidy = scores(records)
    frame = leaderboard.table(records, tidy)
    path = out or (results / "leaderboard.csv" if results else COMMITTED_BOARD)
    leaderboard.write(frame, path)
    typer.echo(f"{path}: {len(frame)} rows")
    if page:
        from dlobench.bench.page import build
        from dlobench.bench.page.libraries import MissingError
        from dlobench.bench.page.shown import shown
        from dlobench.data.store import atomic_write

        try:
            content = build(records, frame, shown(records, frame, results or COMMITTED_RESULTS), tidy)
        except MissingError as error:
            typer.echo(f"no page is written: {error}")
            return
        atomic_write(path.with_name("index.html"), content)
        typer.echo(f"{path.with_name('index.html')}: {len(content) / 1e6:.1f} MB")


def show(frame: Any) -> None:
    """Prints the rows of a leaderboard that matter to who has just run something."""
    from dlobench.console import print_table

    sampled = frame["energy_m"].notna().any()
    header = ["cell", "place", "model@config", "seeds", "skill", "95 %", "MSE cm²"]
    header += ["energy mm" if sampled else "error mm", "parameters", "fit s"]
    rows = [
        [
            row.cell,
            "–" if row.place != row.place else f"{row.place:.0f}{'≈' if row.tie else ''}",
            f"{row.model}@{row.config}",  # what `compare` takes
            str(row.seeds),
            _shown(row.skill),
            "–" if row.skill_low != row.skill_low else f"{_shown(row.skill_low)}…{_shown(row.skill_high)}",
            f"{row.mse_m2 * 1e4:.3f}",
            f"{(row.energy_m if sampled else row.euclidean_m) * 1e3:.2f}",
            f"{row.parameters:,}",
            f"{row.fit_s:.1f}",
        ]
        for row in frame.itertuples()
    ]
    print_table(header, rows)
    if any(row.tie for row in frame.itertuples()):
        typer.echo("≈ ties with a neighbour: the 95 % interval of their difference holds 0, or there is none")


def _shown(skill: float) -> str:
    return f"{round(skill, 3) + 0.0:.3f}"  # never -0.000
