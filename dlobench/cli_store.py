"""Speaks the verbs that look after data: `dlobench data status|verify|repair`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dlobench.cli_look import Data, Json, open_store, print_rows
from dlobench.errors import RunError

if TYPE_CHECKING:
    from dlobench.console import TerminalReporter
    from dlobench.data.domain_set import DomainSet, Unit
    from dlobench.data.executors import Executor
    from dlobench.data.store import Store
    from dlobench.data.verify import Verified

SetName = Annotated[str, typer.Argument(metavar="SET", help="See `dlobench list sets`.")]
AnySet = Annotated[str | None, typer.Argument(metavar="[SET]", help="Default: all sets.")]
Workers = Annotated[int | None, typer.Option(help="Processes that simulate. Default: one a core.")]


def status(set_name: AnySet = None, data: Data = None, as_json: Json = False) -> None:
    """Tell what is done, pending and broken, by sizes and sidecars."""
    from dlobench.data.inventory import other_versions
    from dlobench.data.status import census

    store, rows = open_store(data), []
    for of in _sets(store, set_name):
        found, others = census(store, of), other_versions(store, of)
        for scale, tally in found.scales.items():
            row = {"set": of.name, "scale": scale, **vars(tally), "pushes_per_second": tally.rate}
            rows.append(row | {"folder": str(store.root / of.key), "other_versions": others})
        _tell_broken(store, of, found.broken)
        _tell_rest(of, found.halves, found.temporary, found.strays)
        if others:
            typer.echo(f"other versions of {of.name}, which are left alone: {', '.join(others)}", err=True)
    if not as_json:
        for row in rows:
            row |= {"digest": (row["digest"] or "–")[:12], "pushes/s": f"{row['pushes_per_second'] or 0:.0f}"}
    print_rows(rows, as_json, ["set", "scale", "done", "pending", "broken", "pushes", "pushes/s", "bytes", "digest"])


def verify(
    set_name: AnySet = None,
    data: Data = None,
    workers: Annotated[int | None, typer.Option(help="Processes that read. Default: one a core.")] = None,
    regenerate: Annotated[int, typer.Option(help="Simulate so many shards of each set again, and compare.")] = 0,
    seed: Annotated[int, typer.Option(help="Which shards are simulated again.")] = 0,
    as_json: Json = False,
) -> None:
    """Check every byte on disk against its digest; exit code 1 if anything is broken."""
    from dlobench import ranges
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import find_executor
    from dlobench.data.imported import find_ours
    from dlobench.data.reproduce import chosen, reproduce
    from dlobench.data.sets import SETS

    store, reporter, executor = open_store(data), TerminalReporter(), find_executor("local", workers=workers)
    if ranges.whole("--regenerate", regenerate, 0) and set_name:
        find_ours(store, set_name)
    rows, again = list[dict[str, Any]](), list[dict[str, Any]]()
    for of in _sets(store, set_name):
        found = _verified(store, of, executor, reporter)
        row = {"set": of.name, "shards": found.shards, "bytes": found.bytes, "broken": len(found.broken)}
        rows.append(row | {"without_sidecar": len(found.halves), "strays": [str(path) for path in found.strays]})
        _tell_broken(store, of, found.broken)
        _tell_rest(of, len(found.halves), found.temporary, found.strays)
        if regenerate and of.name in SETS and (set_name or found.shards > len(found.broken)):
            units = chosen(store, of, regenerate, seed=seed, without=found.broken)
            with reporter.bar(f"simulating {of.name} again", "shards") as listen:
                for done, one in enumerate(reproduce(store, of, units, executor), start=1):
                    listen(done, len(units), {})
                    again.append(one.row(store.path(of, one.unit)))
    if as_json:
        typer.echo(json.dumps({"sets": rows, "regenerated": again}, indent=1, ensure_ascii=False))
    else:
        print_rows(rows, as_json, ["set", "shards", "bytes", "broken", "without_sidecar"])
        if again:
            print_rows(again, as_json, list(again[0]))
    _judge({row["set"]: row["broken"] for row in rows if row["broken"]}, again, data)


def _judge(broken: dict[str, int], again: list[dict[str, Any]], data: Path | None) -> None:
    """Raises `RunError` where anything is wrong, with the commands that mend it."""
    from dlobench.data.sets import SETS

    where = "" if data is None else f" --data {data}"
    if broken:
        mend = [f"`dlobench data {'repair' if name in SETS else 'import --name'} {name}{where}`" for name in broken]
        number = sum(broken.values())
        what, them = ("shards are", "them") if number > 1 else ("shard is", "it")
        raise RunError(f"{number} {what} broken; {' and '.join(mend)} brings {them} back")
    wrong = [row["shard"] for row in again if not row["agrees"]]
    if wrong:
        raise RunError(
            f"{len(wrong)} of {len(again)} shards that were simulated again differ from what is on disk, the first "
            f"{wrong[0]}; where they are removed, `dlobench generate` makes them anew"
        )


def repair(
    set_name: SetName,
    scale: Annotated[str | None, typer.Option(help="Generate also what this scale misses.")] = None,
    data: Data = None,
    workers: Workers = None,
) -> None:
    """Generate again what is broken of a set, or has lost its sidecar, and only that."""
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import find_executor
    from dlobench.data.imported import find_ours
    from dlobench.data.sets import find_scale
    from dlobench.data.verify import repair as remake

    store, reporter = open_store(data), TerminalReporter()
    of = find_ours(store, set_name)
    chosen, executor = scale and find_scale(scale), find_executor("local", workers=workers)
    found = _verified(store, of, executor, reporter)
    with reporter.bar("repairing", "pushes") as listen:

        def progress(done: int, total: int) -> None:
            listen(done, total, {})

        made = remake(store, of, found, executor, progress, scale=chosen or None)
    missing = len(made) - len(found.broken) - len(found.halves)
    reporter.say(
        f"data: {len(found.broken)} broken shards of {of.name} generated again, {len(found.halves)} without a sidecar"
        + (f", {missing} missing ones" if chosen else "")
    )


def _verified(store: Store, of: DomainSet, executor: Executor, reporter: TerminalReporter) -> Verified:
    from dlobench.data.verify import verify as check

    with reporter.bar(f"verifying {of.name}", "shards") as listen:
        return check(store, of, executor, lambda done, total, size: listen(done, total, {"GB": size / 1e9}))


def _sets(store: Store, name: str | None) -> list[DomainSet]:
    from dlobench.data.imported import find_any, imported_sets
    from dlobench.data.sets import SETS

    return [*SETS.values(), *imported_sets(store)] if name is None else [find_any(store, name)]


def _tell_broken(store: Store, of: DomainSet, broken: dict[Unit, str]) -> None:
    for unit, why in broken.items():
        typer.echo(f"broken: {store.path(of, unit)}: {why}", err=True)


def _tell_rest(of: DomainSet, halves: int, temporary: list[Path], strays: list[Path]) -> None:
    if halves:
        typer.echo(f"{of.name}: {halves} arrays without a sidecar, which count as pending", err=True)
    if temporary:
        typer.echo(
            f"{of.name}: {len(temporary)} temporary files; once nothing generates, they may go: {temporary[0]}",
            err=True,
        )
    for path in strays:
        typer.echo(f"stray: {path} is no file of {of.name}", err=True)
