"""Speaks the verb `dlobench compare`: the paired difference of two models, cell by cell."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dlobench.cli_board import COMMITTED_RESULTS
from dlobench.cli_data import Scale


def compare(
    a: Annotated[str, typer.Argument(metavar="A", help="A model, or model@config.")],
    b: Annotated[str, typer.Argument(metavar="B", help="The model that it is compared with.")],
    task: Annotated[str, typer.Option(help="A task's name.")],
    scale: Scale = "mini",
    results: Annotated[Path | None, typer.Option(help=f"Folder of records. Default: {COMMITTED_RESULTS}.")] = None,
    metric: Annotated[str, typer.Option(help="skill, mse, euclidean or another score of the records.")] = "skill",
    out: Annotated[Path | None, typer.Option(help="Picture to draw: .png, .svg or .pdf.")] = None,
) -> None:
    """Compare two models on the same domains and seeds: mean difference A − B and its 95 % interval in every cell."""
    from dlobench.bench import compare as bench
    from dlobench.bench.results import read_all
    from dlobench.bench.scores import scores
    from dlobench.console import print_table

    found = bench.compare(scores(read_all(results or COMMITTED_RESULTS)), a, b, task=task, scale=scale, metric=metric)
    factor, unit = {"mse": (1e4, " 1e-4 m²"), "euclidean": (1e3, " mm")}.get(metric, (1.0, ""))

    def shown(value: float | None) -> str:
        return "–" if value is None else f"{value * factor:+.4g}"

    rows = [
        [c.cell, shown(d.estimate), shown(d.low), shown(d.high), str(d.domains), str(d.seeds), c.verdict]
        for c in found
        for d in [c.difference]
    ]
    print_table(["cell", f"{metric} A − B{unit}", "low", "high", "domains", "seeds", f"{a} is"], rows)
    if any(c.difference.seeds == 1 for c in found):
        typer.echo("one seed: its intervals are over domains alone, and another seed may say otherwise")
    if out is not None:
        label = f"{metric} of {a} less that of {b} ({'higher' if metric == 'skill' else 'lower'} is better), 95 %"
        bench.draw(found, out, title=f"{task} at scale {scale}", label=label)
        typer.echo(str(out))
