"""Speaks the verbs that look: `dlobench list …` and `dlobench data …`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dlobench.errors import RunError, UsageError

if TYPE_CHECKING:
    from dlobench.data.sets import DomainSet, ScaleName, Unit
    from dlobench.data.store import Store

list_app = typer.Typer(help="Show what exists: tasks, models, sets.", no_args_is_help=True)
data_app = typer.Typer(help="Look after the data on disk.", no_args_is_help=True)

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Data = Annotated[Path | None, typer.Option(help="Data folder. Default: $DLOBENCH_DATA, else the platform's cache.")]
Workers = Annotated[int, typer.Option(help="Processes that simulate; 0 takes every core.")]


@list_app.command("tasks")
def list_tasks(as_json: Json = False) -> None:
    """List the tasks: what they ask, and their cells at every scale."""
    from dlobench.bench.plugins import find, load_task
    from dlobench.data.sets import SCALES

    rows = []
    for name, found in find("tasks").items():
        task = load_task(name)
        for scale in SCALES:
            cells = [task.cell_id(fit, K) for fit in task.fits(scale) for K in task.scale(scale).K]
            rows.append({"task": name, "about": found.about, "set": task.set, "scale": scale, "cells": cells})
    _show(rows, as_json, ["task", "scale", "cells", "set"])


@list_app.command("models")
def list_models(as_json: Json = False) -> None:
    """List the models: one file each."""
    from dlobench.bench.plugins import find

    rows = [{"model": f.name, "about": f.about, "path": str(f.path)} for f in find("models").values()]
    _show(rows, as_json, ["model", "about"])


@list_app.command("sets")
def list_sets(as_json: Json = False) -> None:
    """List the sets: domains, pushes and bytes at every scale."""
    from dlobench.data.sets import SCALES, SETS
    from dlobench.data.store import BYTES_A_PUSH

    rows = [
        {
            "set": of.name,
            "scale": scale,
            "domains": len(of.domains(scale)),
            "trajectories": of.extents[scale].trajectories,
            "pushes": of.pushes(scale),
            "bytes": round(of.pushes(scale) * BYTES_A_PUSH),
        }
        for of in SETS.values()
        for scale in SCALES
    ]
    _show(rows, as_json, ["set", "scale", "domains", "trajectories", "pushes", "bytes"])


@data_app.command("status")
def data_status(data: Data = None, as_json: Json = False) -> None:
    """Tell what is done, pending and broken, by sizes and sidecars."""
    _report(open_store(data), as_json, every_byte=False)


@data_app.command("verify")
def data_verify(data: Data = None, as_json: Json = False) -> None:
    """Check every byte on disk against its digest; exit code 1 if anything is broken."""
    broken = _report(open_store(data), as_json, every_byte=True)
    if broken:
        raise RunError(f"{len(broken)} shards are broken; `dlobench data repair SET` generates them again")


@data_app.command("repair")
def data_repair(
    set_name: Annotated[str, typer.Argument(metavar="SET", help="See `dlobench list sets`.")],
    data: Data = None,
    workers: Workers = 0,
) -> None:
    """Generate again what is broken of a set, and only that."""
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import check_workers
    from dlobench.data.generate import generate, status
    from dlobench.data.sets import find

    store, of, reporter, processes = open_store(data), find(set_name), TerminalReporter(), check_workers(workers)
    broken = list(status(store, of, _units(of, "paper"), every_byte=True).broken)
    for unit in broken:
        store.discard(of, unit)
    if broken:
        with reporter.bar("repairing", "pushes") as listen:
            generate(store, broken, processes, lambda done, total: listen(done, total, {}))
    reporter.say(f"data: {len(broken)} broken shards of {of.name} generated again")


def open_store(data: Path | None) -> Store:
    """Opens the store of a data folder, by default $DLOBENCH_DATA, else the platform's cache folder."""
    from platformdirs import user_cache_path

    from dlobench.data.store import Store

    environment = os.environ.get("DLOBENCH_DATA")
    root = (data or (Path(environment) if environment else user_cache_path("dlobench"))).expanduser().absolute()
    if root.exists() and not root.is_dir():
        raise UsageError(f"--data {root} is not a folder")
    return Store(root)


def _units(of: DomainSet, scale: ScaleName) -> list[Unit]:
    return list(of.units(of.domains(scale), of.extents[scale].trajectories))


def _report(store: Store, as_json: bool, every_byte: bool) -> list[Unit]:
    """Prints what is there of every set and scale; returns the broken units."""
    from dlobench.data.generate import status
    from dlobench.data.sets import PUSHES, SCALES, SETS

    rows, broken = [], dict[Any, str]()
    for of in SETS.values():
        found = status(store, of, _units(of, "paper"), every_byte=every_byte)
        broken |= found.broken
        done = set(found.done)
        for scale in SCALES:
            units = _units(of, scale)
            have, bad = sum(u in done for u in units), sum(u in found.broken for u in units)
            row = {"set": of.name, "scale": scale, "done": have, "pending": len(units) - have - bad, "broken": bad}
            rows.append(row | {"pushes": have * of.block * PUSHES, "folder": str(store.root / of.key)})
    _show(rows, as_json, ["set", "scale", "done", "pending", "broken", "pushes", "folder"])
    for unit, why in broken.items():
        typer.echo(f"broken: {store.path(SETS[unit.set_name], unit)}: {why}", err=True)
    return list(broken)


def _show(rows: list[dict[str, Any]], as_json: bool, columns: list[str]) -> None:
    from dlobench.console import print_table

    if as_json:
        typer.echo(json.dumps(rows, indent=1, ensure_ascii=False))
        return
    print_table(columns, [[_text(row[column]) for column in columns] for row in rows])


def _text(value: object) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value))
    return f"{value:,}" if isinstance(value, int) else str(value)
