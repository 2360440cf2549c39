"""Speaks the verb that makes data, `dlobench generate`, and gathers those of `dlobench data`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dlobench.cli_describe import card, plan
from dlobench.cli_exchange import export, import_
from dlobench.cli_look import open_store
from dlobench.cli_store import SetName, repair, status, verify
from dlobench.errors import UsageError

data_app = typer.Typer(help="Look after the data on disk.", no_args_is_help=True)

Scale = Annotated[str, typer.Option(help="How much: mini (minutes), small (hours), paper (a cluster).")]


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
    from dlobench.console import TerminalReporter
    from dlobench.data.ensure import ensure_data, missing
    from dlobench.data.executors import find_executor
    from dlobench.data.imported import find_ours
    from dlobench.data.sets import find_scale
    from dlobench.data.slurm import Slurm

    store, reporter, chosen = open_store(data), TerminalReporter(), find_scale(scale)
    of = find_ours(store, set_name)
    spans = of.spans(chosen)
    order = list(dict.fromkeys(span.domain for span in spans))
    if domains is not None and not 1 <= domains <= len(order):
        raise UsageError(f"--domains {domains} is outside 1–{len(order)}, what {set_name}/{scale} has")
    wanted = set(order[:domains])
    spans = [span for span in spans if span.domain in wanted]
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


data_app.command("status")(status)
data_app.command("verify")(verify)
data_app.command("repair")(repair)
data_app.command("export")(export)
data_app.command("import")(import_)
data_app.command("plan")(plan)
data_app.command("card")(card)
