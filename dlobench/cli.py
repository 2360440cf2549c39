"""Speaks the command line: verbs only. What a verb needs is imported when it is called, so that help is instant."""

from __future__ import annotations

import json
import os
import shlex
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dlobench import __version__
from dlobench.errors import RunError, UsageError

if TYPE_CHECKING:
    from dlobench.data.sets import DomainSet, ScaleName, Unit
    from dlobench.data.store import Store

COMMITTED_RESULTS = Path("leaderboard/results")
COMMITTED_BOARD = Path("leaderboard/leaderboard.csv")

app = typer.Typer(
    help="A benchmark of models of deformable-object dynamics.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
list_app = typer.Typer(help="Show what exists: tasks, models, sets.", no_args_is_help=True)
data_app = typer.Typer(help="Look after the data on disk.", no_args_is_help=True)
leaderboard_app = typer.Typer(help="Build the leaderboard.", no_args_is_help=True)
app.add_typer(list_app, name="list")
app.add_typer(data_app, name="data")
app.add_typer(leaderboard_app, name="leaderboard")

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Data = Annotated[Path | None, typer.Option(help="Data folder. Default: $DLOBENCH_DATA, else the platform's cache.")]
Scale = Annotated[str, typer.Option(help="How much: mini (minutes), small (a night), paper (a cluster).")]
Workers = Annotated[int, typer.Option(help="Processes that simulate; 0 takes every core.")]


def _version(wanted: bool) -> None:
    if wanted:
        from dlobench.machine import versions

        found = versions()
        typer.echo(f"dlobench {__version__}, mujoco {found['mujoco']}, torch {found['torch']}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print versions and exit.")
    ] = False,
) -> None:
    pass


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


@app.command()
def generate(
    set_name: Annotated[str, typer.Argument(metavar="SET", help="See `dlobench list sets`.")],
    scale: Scale = "mini",
    domains: Annotated[int | None, typer.Option(help="Only so many domains, spread over the cells.")] = None,
    data: Data = None,
    workers: Workers = 0,
    executor: Annotated[str, typer.Option(help="Where to run: local.")] = "local",
) -> None:
    """Generate what is missing of a set. Stop it at any time: the next call goes on."""
    from dlobench.bench.run import ensure_data
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import EXECUTORS, check_workers
    from dlobench.data.sets import find, find_scale

    of, chosen = find(set_name), find_scale(scale)
    if executor not in EXECUTORS:
        raise UsageError(f"unknown executor {executor!r}; there are: {', '.join(EXECUTORS)}")
    spread = of.spread(chosen)
    if domains is not None and not 1 <= domains <= len(spread):
        raise UsageError(f"--domains {domains} is outside 1–{len(spread)}, what {set_name}/{scale} has")
    trajectories = of.extents[chosen].trajectories
    ensure_data(
        _store(data),
        of,
        spread[:domains],
        trajectories,
        workers=check_workers(workers),
        reporter=TerminalReporter(),
    )


@data_app.command("status")
def data_status(data: Data = None, as_json: Json = False) -> None:
    """Tell what is done, pending and broken, by sizes and sidecars."""
    _report(_store(data), as_json, every_byte=False)


@data_app.command("verify")
def data_verify(data: Data = None, as_json: Json = False) -> None:
    """Check every byte on disk against its digest; exit code 1 if anything is broken."""
    broken = _report(_store(data), as_json, every_byte=True)
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

    store, of, reporter = _store(data), find(set_name), TerminalReporter()
    broken = list(status(store, of, _units(of, "paper"), every_byte=True).broken)
    for unit in broken:
        store.discard(of, unit)
    if broken:
        with reporter.bar("repairing", "pushes") as listen:
            generate(store, broken, check_workers(workers), lambda done, total: listen(done, total, {}))
    reporter.say(f"data: {len(broken)} broken shards of {of.name} generated again")


@app.command()
def run(
    task: Annotated[str, typer.Option(help="A task's name or file.")],
    model: Annotated[str, typer.Option(help="A model's name or file.")],
    K: Annotated[int | None, typer.Option("--K", help="Support trajectories. Default: all of the task.")] = None,
    horizon: Annotated[int | None, typer.Option(help="Pushes ahead. Default: all of the task.")] = None,
    scale: Scale = "mini",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the model.")] = 0,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="FIELD=VALUE", help="A hyperparameter.")
    ] = None,
    max_steps: Annotated[int | None, typer.Option(min=1, help="Cut every fit after so many steps.")] = None,
    max_minutes: Annotated[float | None, typer.Option(min=0.0, help="Stop every fit after so many minutes.")] = None,
    data: Data = None,
    out: Annotated[Path, typer.Option(help="Where records and their leaderboard go.")] = Path("runs"),
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    workers: Workers = 0,
    force: Annotated[bool, typer.Option("--force", help="Run again what is recorded already.")] = False,
) -> None:
    """Run a model on a task: generate what is missing, fit, adapt, score, record, print the board."""
    from dlobench.bench import leaderboard, results
    from dlobench.bench import run as bench
    from dlobench.bench.plugins import load_model, load_task, parse_settings
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import check_workers
    from dlobench.data.sets import find_scale
    from dlobench.nn.budget import Budget

    plugin = load_model(model)
    order = bench.order(
        load_task(task),
        find_scale(scale),
        plugin,
        K,
        horizon,
        seed=seed,
        settings=parse_settings(plugin.model, settings or []),
        budget=Budget(steps=max_steps, minutes=max_minutes),
        device=bench.resolve_device(device),
    )
    if out.is_dir():
        results.read_all(out)  # a foreign file would spoil the board: better said now than after the fit
    command = shlex.join(["dlobench", *sys.argv[1:]])
    record = bench.run(
        order,
        _store(data),
        out,
        command=command,
        workers=check_workers(workers),
        reporter=TerminalReporter(),
        force=force,
    )
    frame = leaderboard.table(results.read_all(out))
    leaderboard.write(frame, out / "leaderboard.csv")
    _board(frame[frame["cell"].isin([cell.id for cell in record.cells]) & (frame["scale"] == record.scale)])


@app.command()
def check(path: Annotated[str, typer.Argument(metavar="PATH", help="A model plugin: its file or name.")]) -> None:
    """Check that a plugin keeps the contract, on a tiny set, in seconds."""
    from dlobench.bench.contract import check as outcomes
    from dlobench.bench.plugins import load_model

    failed = 0
    for outcome in outcomes(load_model(path)):
        typer.echo(f"{'ok    ' if outcome.passed else 'FAILED'}  {outcome.name}{outcome.why and ': ' + outcome.why}")
        failed += not outcome.passed
    if failed:
        raise RunError(f"{path} breaks the contract in {failed} point{'s' * (failed > 1)}")


@leaderboard_app.command("build")
def leaderboard_build(
    results: Annotated[Path | None, typer.Option(help=f"Folder of records. Default: {COMMITTED_RESULTS}.")] = None,
    out: Annotated[Path | None, typer.Option(help="CSV to write. Default: leaderboard.csv beside the records.")] = None,
) -> None:
    """Build the leaderboard from the records. The same records give the same bytes."""
    from dlobench.bench import leaderboard
    from dlobench.bench.results import read_all

    frame = leaderboard.table(read_all(results or COMMITTED_RESULTS))
    path = out or (results / "leaderboard.csv" if results else COMMITTED_BOARD)
    leaderboard.write(frame, path)
    typer.echo(f"{path}: {len(frame)} rows")


def _store(data: Path | None) -> Store:
    from platformdirs import user_cache_path

    from dlobench.data.store import Store

    environment = os.environ.get("DLOBENCH_DATA")
    return Store((data or (Path(environment) if environment else user_cache_path("dlobench"))).expanduser().absolute())


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


def _board(frame: Any) -> None:
    """Prints the rows of a leaderboard that matter to who has just run something."""
    from dlobench.console import print_table

    header = ["cell", "scale", "model", "config", "seeds", "skill", "MSE 1e-4 m²", "error mm", "parameters", "fit s"]
    rows = [
        [
            row.cell,
            row.scale,
            row.model,
            row.config,
            str(row.seeds),
            f"{row.skill:.3f}",
            f"{row.mse_m2 * 1e4:.3f}",
            f"{row.euclidean_m * 1e3:.2f}",
            f"{row.parameters:,}",
            f"{row.fit_s:.1f}",
        ]
        for row in frame.itertuples()
    ]
    print_table(header, rows)


def main() -> None:
    """Runs the command line. Exit codes: 0 done, 1 a run failed, 2 bad usage, 130 interrupted."""
    from dlobench.console import fail

    debug = bool(os.environ.get("DLOBENCH_DEBUG"))
    try:
        code = app(standalone_mode=False)
    except (UsageError, RunError) as error:
        if debug:
            traceback.print_exc()
        fail(str(error))
        code = error.exit_code
    except (KeyboardInterrupt, typer.Abort):
        fail("interrupted; what is done is kept, and the same command goes on from there")
        code = 130
    except Exception as error:
        # Errors of the command line itself carry what to say; they live in a private module of typer.
        if not hasattr(error, "format_message"):
            raise
        fail(error.format_message())
        code = getattr(error, "exit_code", 2)
    sys.exit(code or 0)
