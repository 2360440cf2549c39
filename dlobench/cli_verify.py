"""Speaks the verbs of who keeps a board: `dlobench leaderboard verify` and `dlobench leaderboard add`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dlobench.cli_board import COMMITTED_RESULTS
from dlobench.cli_look import Data, open_store
from dlobench.cli_run import MemoryLimit, TimeLimit
from dlobench.cli_store import Workers
from dlobench.errors import RunError, UsageError

Results = Annotated[Path | None, typer.Option(help=f"Folder of records. Default: {COMMITTED_RESULTS}.")]


def leaderboard_verify(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="[FILE]...", help="Records or submissions. Default: all records.")
    ] = None,
    results: Results = None,
    fresh: Annotated[
        int | None,
        typer.Option(min=0, help="Score the weights of each FILE on new domains of this seed, drawn after they came."),
    ] = None,
    data: Data = None,
    workers: Workers = None,
    time_limit: TimeLimit = 600.0,
    memory_limit: MemoryLimit = None,
) -> None:
    """Hold records against what they came from: seals, digests, versions, and scores made again from predictions."""
    import tempfile

    from dlobench.bench import results as records
    from dlobench.bench import submission
    from dlobench.bench.verify import verify

    if fresh is not None and not files:
        raise UsageError("--fresh needs the FILEs whose weights are to be scored")
    folder, failed, count = results or COMMITTED_RESULTS, 0, 0
    with tempfile.TemporaryDirectory(prefix="dlobench-") as scratch:
        groups: list[tuple[list[Path], Path]] = []
        names: dict[Path, str] = {}  # what records are to be called that were unpacked
        for number, file in enumerate(files or []):
            if file.suffix == ".zip":
                inside = Path(scratch) / str(number)
                groups.append((submission.unpack(file, inside, weights=True), inside))
                names |= {path: f"{file}: {path.relative_to(inside)}" for path in groups[-1][0]}
            elif len(file.parts) >= 4 and file.suffix == ".json":
                groups.append(([file], Path(*file.parts[:-4])))
            else:
                raise UsageError(f"{file} is neither a record (…/task/scale/model@config/seed0.json) nor a .zip")
        for paths, inside in groups or [(records.paths(folder), folder)]:
            for found in verify(paths, inside):
                count += 1
                typer.echo(f"{'REJECTED' if found.wrong else 'ok'}  {names.get(found.path, found.path)}")
                for why in found.wrong:
                    typer.echo(f"    {why}")
                if found.wrong:
                    failed += 1
                elif fresh is not None:
                    failed += not _fresh(found.path, inside, fresh, data, workers, time_limit, memory_limit)
    if failed:
        raise RunError(f"of {count} record{'s' * (count != 1)}, {failed} {'do' if failed > 1 else 'does'} not hold")
    typer.echo(f"{count} record{'s hold' if count != 1 else ' holds'}")


def _fresh(
    path: Path,
    folder: Path,
    seed: int,
    data: Path | None,
    workers: int | None,
    time_limit: float,
    memory_limit: float | None,
) -> bool:
    """Prints what becomes of a record on new domains, and returns whether it holds."""
    from dlobench.bench import results
    from dlobench.bench.fresh import fresh
    from dlobench.bench.limits import limits
    from dlobench.bench.sandbox import Sandbox
    from dlobench.bench.verify import PLUGIN
    from dlobench.console import TerminalReporter, print_table
    from dlobench.data.executors import find_executor

    record, store = results.read(path, folder), open_store(data)
    with Sandbox(limits(time_limit, memory_limit), hidden=[store.root]) as sandbox:
        plugin = sandbox.load(str(path.with_name(PLUGIN)))
        executor = find_executor("local", workers=workers)
        found = fresh(record, path, plugin, seed, store, executor=executor, reporter=TerminalReporter())
    rows = [
        [
            one.cell,
            f"{one.recorded:.3f}",
            f"{one.fresh:.3f}",
            f"{one.low:+.3f}…{one.high:+.3f}",
            str(one.domains),
            "holds" if one.holds else "WORSE",
        ]
        for one in found
    ]
    print_table(["cell", "skill", "on new domains", "difference, 95 %", "domains", ""], rows)
    return all(one.holds for one in found)


def leaderboard_add(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A submission, made by `dlobench submit`.")],
    results: Results = None,
) -> None:
    """Verify a submission and take its records, predictions and plugin among the results; weights stay behind."""
    import tempfile

    from dlobench.bench import submission
    from dlobench.bench.verify import verify

    folder = results or COMMITTED_RESULTS
    with tempfile.TemporaryDirectory(prefix="dlobench-") as scratch:
        wrong = [
            why
            for found in verify(submission.unpack(file, Path(scratch), weights=False), Path(scratch))
            for why in found.wrong
        ]
    if wrong:
        raise RunError(f"{file} does not hold: {'; '.join(wrong)}")
    for record in submission.unpack(file, folder, weights=False):
        typer.echo(str(record))
    typer.echo("`dlobench leaderboard build` puts them on the board")
