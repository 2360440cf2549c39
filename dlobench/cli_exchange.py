"""Speaks the verbs that exchange data with others: `dlobench data export|import`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dlobench.cli_look import Data, open_store
from dlobench.errors import UsageError

if TYPE_CHECKING:
    from dlobench.data.domain_set import DomainSet, Part, ScaleName
    from dlobench.data.store import Store


def export(
    set_name: Annotated[str, typer.Argument(metavar="SET", help="A set of `dlobench list sets`, or an imported one.")],
    original: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to write in the original layout, a folder a domain.")
    ] = None,
    parquet: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to write as Parquet, a file a domain, a row a state.")
    ] = None,
    scale: Annotated[str, typer.Option(help="How much: mini, small or paper.")] = "mini",
    domains: Annotated[int | None, typer.Option(help="Only so many domains, spread over the cells.")] = None,
    part: Annotated[str | None, typer.Option(help="Only train, valid or test. Default: all.")] = None,
    data: Data = None,
) -> None:
    """Write what was generated of a set in the layout of the original DLO@Scale, or as Parquet."""
    from dlobench.console import TerminalReporter
    from dlobench.data.domain_set import PARTS
    from dlobench.data.imported import find_any
    from dlobench.data.original import export as write
    from dlobench.data.original import plan
    from dlobench.data.sets import find_scale

    store, chosen, reporter = open_store(data), find_scale(scale), TerminalReporter()
    known = next((name for name in PARTS if name == part), None)
    if known != part:
        raise UsageError(f"--part {part!r} is not one of {', '.join(PARTS)}")
    of = find_any(store, set_name)
    if original is None or parquet is not None:
        if parquet is None or original is not None:
            raise UsageError("give --original DIR or --parquet DIR, which is the layout to write")
        _export_parquet(store, of, chosen, parquet.expanduser().absolute(), domains, known)
        return
    folder = original.expanduser().absolute()
    planned = plan(store, of, chosen, folder, domains=domains, part=known)
    with reporter.bar("exporting", "domains") as listen:
        write(store, of, planned, folder, lambda done, total: listen(done, total, {}))
    reporter.say(f"data: {len(planned)} domains of {of.name} in {folder}")


def _export_parquet(
    store: Store, of: DomainSet, scale: ScaleName, folder: Path, domains: int | None, part: Part | None
) -> None:
    """Writes some domains of a scale, all parts or one, as Parquet."""
    from dlobench.console import TerminalReporter
    from dlobench.data.parquet import export as write

    reporter, spans = TerminalReporter(), [span for span in of.spans(scale) if part in (None, span.part)]
    order = list(dict.fromkeys(span.domain for span in spans))
    if not order:
        raise UsageError(f"{of.name} has no part {part}")
    if domains is not None and not 1 <= domains <= len(order):
        raise UsageError(f"--domains {domains} is outside 1–{len(order)}, what {of.name}/{scale} has")
    chosen = set(order[:domains])
    with reporter.bar("exporting", "domains") as listen:
        wanted = [span for span in spans if span.domain in chosen]
        states = write(store, of, wanted, folder, lambda done, total: listen(done, total, {}))
    reporter.say(f"data: {len(chosen)} domains of {of.name}, {states:,} states in {folder}")


def import_(
    original: Annotated[Path, typer.Option(metavar="DIR", help="Folder in the original layout, a folder a domain.")],
    name: Annotated[str, typer.Option(help="What the set shall be called.")] = "original",
    data: Data = None,
) -> None:
    """Read a folder in the layout of the original DLO@Scale, to run tasks on it: `dlobench run --on NAME`."""
    from dlobench.console import TerminalReporter
    from dlobench.data.imported import check_name, import_set
    from dlobench.data.recorded import folders

    store, reporter = open_store(data), TerminalReporter()
    check_name(name)
    found = folders(original.expanduser().absolute())
    with reporter.bar("importing", "domains") as listen:
        of = import_set(store, found, name, lambda done, total: listen(done, total, {}))
    trajectories = sum(domain.trajectories for domain in of.domains.values())
    reporter.say(f"data: {len(of)} domains, {trajectories:,} trajectories in {store.root / of.key}")
    for text in sorted({text for domain in of.domains.values() for text in domain.assumed}):
        reporter.say(f"data: the files do not say it, so {text}")
    reporter.say(f"data: `dlobench run --task TASK --model MODEL --on {of.name}` runs a task on it")
