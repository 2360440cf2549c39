"""Speaks the verbs that make and look after data: `dlobench generate` and `dlobench data status|verify|repair`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dlobench.cli_look import Data, Json, open_store, print_rows
from dlobench.errors import RunError, UsageError

if TYPE_CHECKING:
    from dlobench.data.domain_set import Unit
    from dlobench.data.store import Store

data_app = typer.Typer(help="Look after the data on disk.", no_args_is_help=True)

SetName = Annotated[str, typer.Argument(metavar="SET", help="See `dlobench list sets`.")]
Scale = Annotated[str, typer.Option(help="How much: mini (minutes), small (hours), paper (a cluster).")]
Workers = Annotated[int | None, typer.Option(help="Processes that simulate. Default: one a core.")]


def generate(
    set_name: SetName,
    scale: Scale = "mini",
    domains: Annotated[int | None, typer.Option(help="Only so many domains, spread over the cells.")] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Data folder; all nodes of a cluster must see it. Default: $DLOBENCH_DATA, else the platform's cache."
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Processes, CPUs of a Ray of its own, or SLURM tasks at a time. Default: cores; SLURM 64."),
    ] = None,
    executor: Annotated[str, typer.Option(help="Where to run: local, ray or slurm.")] = "local",
    address: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="The Ray cluster to use. Default: one of its own on this machine."),
    ] = None,
    slurm: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="An option of sbatch, as in partition=batch.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write SLURM's script, and submit nothing.")] = False,
) -> None:
    """Generate what is missing of a set. Stop it at any time: the next call goes on."""
    from dlobench.bench.run import ensure_data, missing
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import find_executor
    from dlobench.data.sets import find, find_scale
    from dlobench.data.slurm import Slurm

    of, chosen = find(set_name), find_scale(scale)
    spans = of.spans(chosen)
    order = list(dict.fromkeys(span.domain for span in spans))
    if domains is not None and not 1 <= domains <= len(order):
        raise UsageError(f"--domains {domains} is outside 1–{len(order)}, what {set_name}/{scale} has")
    wanted = set(order[:domains])
    spans = [span for span in spans if span.domain in wanted]
    store, reporter = open_store(data), TerminalReporter()
    where = find_executor(
        executor,
        workers=workers,
        address=address,
        slurm=slurm or (),
        dry_run=dry_run,
        folder=store.root / "slurm",
    )
    if dry_run and isinstance(where, Slurm):
        pending, there = missing(store, of, spans)
        reporter.say(f"data: {there} shards reused, {len(pending)} to generate into {store.root / of.key}")
        if pending:
            path, tasks = where.script(len(pending))
            reporter.say(f"data: {path} holds what would be submitted, an array of {tasks}; nothing was")
        return
    ensure_data(store, of, spans, executor=where, reporter=reporter)


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
def data_repair(set_name: SetName, data: Data = None, workers: Workers = None) -> None:
    """Generate again what is broken of a set, and only that."""
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import find_executor
    from dlobench.data.generate import generate, status
    from dlobench.data.sets import find

    store, of, reporter = open_store(data), find(set_name), TerminalReporter()
    executor = find_executor("local", workers=workers)
    broken = list(status(store, of, of.units(of.spans("paper")), every_byte=True).broken)
    for unit in broken:
        store.discard(of, unit)
    if broken:
        with reporter.bar("repairing", "pushes") as listen:
            generate(store, of, broken, executor, lambda done, total: listen(done, total, {}))
    reporter.say(f"data: {len(broken)} broken shards of {of.name} generated again")


def _report(store: Store, as_json: bool, every_byte: bool) -> list[Unit]:
    """Prints what is there of every set and scale; returns the broken units."""
    from dlobench.data.domain_set import SCALES
    from dlobench.data.generate import status
    from dlobench.data.sets import SETS

    rows, broken = [], dict[Any, str]()
    for of in SETS.values():
        found = status(store, of, of.units(of.spans("paper")), every_byte=every_byte)
        broken |= found.broken
        done = set(found.done)
        for scale in SCALES:
            units = list(of.units(of.spans(scale)))
            have, bad = sum(u in done for u in units), sum(u in found.broken for u in units)
            row = {"set": of.name, "scale": scale, "done": have, "pending": len(units) - have - bad, "broken": bad}
            rows.append(row | {"pushes": have * of.block * of.pushes, "folder": str(store.root / of.key)})
    print_rows(rows, as_json, ["set", "scale", "done", "pending", "broken", "pushes", "folder"])
    for unit, why in broken.items():
        typer.echo(f"broken: {store.path(SETS[unit.set_name], unit)}: {why}", err=True)
    return list(broken)
