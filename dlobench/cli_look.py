"""Speaks the verbs that look: `dlobench list …`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from dlobench.data.store import Store

list_app = typer.Typer(help="Show what exists: tasks, models, sets.", no_args_is_help=True)

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Data = Annotated[Path | None, typer.Option(help="Data folder. Default: $DLOBENCH_DATA, else the platform's cache.")]


@list_app.command("tasks")
def list_tasks(as_json: Json = False) -> None:
    """List the tasks: at every scale what they read, how many fits they take, and over what they sweep."""
    from dlobench.bench.plugins import find, load_task
    from dlobench.data.domain_set import SCALES

    rows = []
    for name, found in find("tasks").items():
        task = load_task(name)
        for scale in SCALES:
            spans = task.spans(scale)
            chosen, fits = task.scale(scale), task.fits(scale)
            rows.append(
                {
                    "task": name,
                    "about": found.about,
                    "scale": scale,
                    "set": " ".join(filter(None, [task.set, task.futures])),
                    "domains": len({span.domain for members in spans.values() for span in members}),
                    "pushes": sum(task.set_of(part).total(members) for part, members in spans.items()),
                    "fits": len(fits),
                    "trajectories": list(chosen.trajectories),
                    "horizon": list(task.horizon),
                    "K": list(chosen.K),
                    "cells": task.cells(scale, chosen.K),
                }
            )
    columns = ["task", "scale", "set", "domains", "pushes", "fits", "trajectories", "horizon", "K"]
    print_rows(rows, as_json, columns)


@list_app.command("models")
def list_models(as_json: Json = False) -> None:
    """List the models: one file each."""
    from dlobench.bench.plugins import find

    rows = [{"model": f.name, "about": f.about, "path": str(f.path)} for f in find("models").values()]
    print_rows(rows, as_json, ["model", "about"])


@list_app.command("sets")
def list_sets(as_json: Json = False) -> None:
    """List the sets: domains, pushes, bytes and estimated core-hours at every scale."""
    from dlobench.data.domain_set import SCALES
    from dlobench.data.plan import estimated_hours
    from dlobench.data.sets import SETS
    from dlobench.data.store import data_bytes

    rows = []
    for of in SETS.values():
        for scale in SCALES:
            spans = of.spans(scale)
            rows.append(
                {
                    "set": of.name,
                    "scale": scale,
                    "domains": len({span.domain for span in spans}),
                    "trajectories": sum(span.count for span in spans),
                    "pushes": of.total(spans),
                    "bytes": data_bytes(of, spans),
                    "core_hours": round(estimated_hours(of, spans), 2),
                }
            )
    print_rows(rows, as_json, ["set", "scale", "domains", "trajectories", "pushes", "bytes", "core_hours"])


def open_store(data: Path | None) -> Store:
    """Opens the store of a data folder, by default $DLOBENCH_DATA, else the platform's cache folder."""
    from dlobench.data.store import Store

    return Store.open(data)


def print_rows(rows: list[dict[str, Any]], as_json: bool, columns: list[str]) -> None:
    """Prints rows as a table of some columns, or whole as JSON."""
    from dlobench.console import print_table

    if as_json:
        typer.echo(json.dumps(rows, indent=1, ensure_ascii=False))
        return
    print_table(columns, [[_text(row[column]) for column in columns] for row in rows])


def _text(value: object) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value))
    return f"{value:,}" if isinstance(value, int) else str(value)
