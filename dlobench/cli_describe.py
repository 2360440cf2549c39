"""Speaks the verbs that describe data: `dlobench data plan|card`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from dlobench.cli_look import Data, Json, open_store, print_rows
from dlobench.cli_store import SetName

Scale = Annotated[str, typer.Option(help="How much: mini, small or paper.")]


def plan(
    set_name: SetName,
    scale: Scale = "mini",
    workers: Annotated[int | None, typer.Option(help="Workers to plan for. Default: one a core here.")] = None,
    seconds: Annotated[float, typer.Option(min=0.0, max=3600.0, help="How long to measure.")] = 8.0,
    as_json: Json = False,
) -> None:
    """Measure this machine for a few seconds, and tell what generating a set takes: hours, disk, files."""
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import check_workers, cores, find_executor
    from dlobench.data.plan import plan as make
    from dlobench.data.sets import find, find_scale

    of, chosen = find(set_name), find_scale(scale)
    wanted, reporter = check_workers(workers), TerminalReporter()
    busy = min(wanted, cores())
    reporter.say(
        f"plan: simulates beginnings of shards on {busy} of {cores()} cores here for {seconds:g} s, keeps nothing"
    )
    with reporter.bar("measuring", "seconds") as listen:
        found = make(
            of,
            of.spans(chosen),
            find_executor("local", workers=busy),
            workers=wanted,
            seconds=seconds,
            progress=lambda done, total: listen(done, total, {}),
        )
    row = {"set": of.name, "scale": chosen, **asdict(found)}
    if as_json:
        print_rows([row], as_json, [])
        return
    error = 100 * found.uncertainty
    row |= {name: f"{row[name]:,.3g} ± {error:.0f} %" for name in ("core_hours", "wall_hours")}
    print_rows([{"what": name, "value": value} for name, value in row.items()], as_json, ["what", "value"])


def card(
    set_name: SetName,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the card; that of a Parquet export fits well.")],
    scale: Scale = "mini",
    data: Data = None,
) -> None:
    """Write a dataset card: README.md for people, croissant.json for programs, and the tables that it speaks of."""
    from dlobench.console import TerminalReporter
    from dlobench.data.card import write
    from dlobench.data.sets import find, find_scale

    of, chosen, reporter = find(set_name), find_scale(scale), TerminalReporter()
    folder = out.expanduser().absolute()
    with reporter.bar("describing", "shards") as listen:
        shards = write(open_store(data), of, chosen, folder, lambda done, total: listen(done, total, {}))
    reporter.say(f"data: a card of {of.name}/{chosen} and {shards:,} shards of it in {folder}")
