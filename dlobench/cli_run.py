"""Speaks the verbs that run models: `dlobench run` and `dlobench submit`."""

from __future__ import annotations

import math
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dlobench.cli_board import show
from dlobench.cli_data import Scale
from dlobench.cli_look import Data, open_store
from dlobench.cli_store import Workers
from dlobench.errors import RunError, UsageError

if TYPE_CHECKING:
    from dlobench.bench.limits import Limits
    from dlobench.bench.record import Record
    from dlobench.bench.run import Fitting

TimeLimit = Annotated[
    float, typer.Option(help="Seconds that each call into the plugin may take; its import has 120 at least.")
]
MemoryLimit = Annotated[
    float | None, typer.Option(help="GB that the plugin may hold. Default: three quarters of the machine's.")
]
Task = Annotated[str, typer.Option(help="A task's name or file.")]
Support = Annotated[int | None, typer.Option("--K", help="Support trajectories. Default: all of the task.")]
Seeds = Annotated[
    str, typer.Option("--seeds", "--seed", metavar="SEEDS", help="Seeds of the model, such as 0, 0-4 or 0,7.")
]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="FIELD=VALUE", help="A hyperparameter, or preset=NAME.")
]
MaxMinutes = Annotated[float | None, typer.Option(min=0.0, help="Stop every fit after so many minutes.")]
Out = Annotated[Path, typer.Option(help="Where records and their leaderboard go.")]


def run(
    task: Task,
    model: Annotated[str, typer.Option(help="A model's name or file.")],
    K: Support = None,
    horizon: Annotated[int | None, typer.Option(help="Pushes ahead. Default: all of the task.")] = None,
    scale: Scale = "mini",
    seeds: Seeds = "0",
    settings: Settings = None,
    max_steps: Annotated[int | None, typer.Option(min=1, help="Cut every fit after so many steps.")] = None,
    max_minutes: MaxMinutes = None,
    on: Annotated[
        str | None, typer.Option(metavar="NAME", help="An imported set to run the task on, rather than its own.")
    ] = None,
    data: Data = None,
    out: Out = Path("runs"),
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    workers: Workers = None,
    executor: Annotated[
        str, typer.Option(help="Where fits are made: local, one after the other, or ray, many at once.")
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="The Ray cluster to use. Default: one of its own on this machine."),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of torch; small networks gain nothing from more.")] = 1,
    time_limit: TimeLimit = 6 * 3600.0,
    memory_limit: MemoryLimit = None,
    wandb: Annotated[
        str, typer.Option(help="Tell Weights & Biases of curves, scores and predictions: disabled, offline or online.")
    ] = "disabled",
    force: Annotated[bool, typer.Option("--force", help="Run again what is recorded already.")] = False,
    keep_going: Annotated[bool, typer.Option("--keep-going", help="Record fits that fail, and go on.")] = False,
) -> None:
    """Run a model on a task: generate what is missing, fit, adapt, score, record, print the board."""
    _records(
        task,
        model,
        seeds,
        settings,
        K=K,
        horizon=horizon,
        scale=scale,
        budget=(max_steps, max_minutes),
        on=on,
        data=data,
        out=out,
        device=device,
        workers=workers,
        executor=executor,
        address=address,
        threads=threads,
        limit=(time_limit, memory_limit),
        wandb=wandb,
        force=force,
        keep_going=keep_going,
    )


def submit(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A model plugin: its file or name.")],
    task: Task,
    scale: Scale = "mini",
    seeds: Seeds = "0",
    settings: Settings = None,
    max_minutes: MaxMinutes = None,
    data: Data = None,
    out: Out = Path("runs"),
    workers: Workers = None,
    time_limit: TimeLimit = 6 * 3600.0,
    memory_limit: MemoryLimit = None,
) -> None:
    """Run a model on a task and pack records, predictions, weights and plugin into one file to hand in."""
    from dlobench.bench import submission
    from dlobench.bench.verify import verify

    records = _records(
        task,
        file,
        seeds,
        settings,
        scale=scale,
        budget=(None, max_minutes),
        data=data,
        out=out,
        workers=workers,
        limit=(time_limit, memory_limit),
    )
    paths = [record.path(out) for record in records]
    wrong = [why for found in verify(paths, out) for why in found.wrong]
    if wrong:
        raise RunError(f"what was recorded does not hold: {'; '.join(wrong)}")
    first = records[0]
    packed = out.parent / f"{first.model}-{first.config}-{first.task}-{first.scale}.zip"
    size = submission.pack(paths, out, packed)
    typer.echo(f"{packed}: {len(paths)} record{'s' * (len(paths) > 1)}, {size / 1e6:.1f} MB; it holds")


def _records(
    task: str,
    model: str,
    seeds: str,
    settings: list[str] | None,
    *,
    budget: tuple[int | None, float | None],
    limit: tuple[float, float | None],
    scale: str,
    data: Path | None,
    out: Path,
    workers: int | None,
    K: int | None = None,
    horizon: int | None = None,
    on: str | None = None,
    device: str = "auto",
    executor: str = "local",
    address: str | None = None,
    threads: int = 1,
    wandb: str = "disabled",
    force: bool = False,
    keep_going: bool = False,
) -> list[Record]:
    """Runs every seed, writes and prints the board, and returns the records."""
    from dlobench.bench import leaderboard, results
    from dlobench.bench import run as bench
    from dlobench.bench.limits import limits
    from dlobench.bench.order import order, parse_seeds, resolve_device
    from dlobench.bench.plugins import load_task
    from dlobench.bench.sandbox import Sandbox
    from dlobench.bench.tracking import tracker
    from dlobench.console import TerminalReporter
    from dlobench.data.executors import find_executor
    from dlobench.data.imported import check_whole, find_imported
    from dlobench.data.sets import find_scale
    from dlobench.nn.budget import Budget

    asked, store, numbers = load_task(task), open_store(data), parse_seeds(seeds)
    told, allowed = tracker(wandb, out), limits(*limit)
    fitting = _fitting(executor, address, workers, allowed, threads)
    with told, Sandbox(allowed, hidden=[store.root, out], threads=threads) as sandbox:
        imported = None if on is None else find_imported(store, on)
        wanted = order(
            asked if imported is None else asked.on(imported),
            find_scale(scale),
            sandbox.load(model),
            K,
            horizon,
            settings=sandbox.parse_settings(settings or []),
            budget=Budget(steps=budget[0], minutes=budget[1]),
            device=resolve_device(device),
        )
        _check_out(out, budget[1])
        if imported is not None:
            check_whole(store, imported, [span for spans in wanted.spans.values() for span in spans])
        records = [
            bench.run(
                wanted.seeded(seed),
                store,
                out,
                command=_command(),
                executor=find_executor("local", workers=workers),
                reporter=TerminalReporter(),
                fitting=fitting,
                tracker=told,
                force=force,
                keep_going=keep_going,
            )
            for seed in numbers
        ]
    frame = leaderboard.table(results.read_all(out))
    leaderboard.write(frame, out / "leaderboard.csv")
    cells = {cell.id for record in records for cell in record.cells}
    show(frame[frame["cell"].isin(cells) & (frame["scale"] == wanted.scale)])
    return records


def _fitting(executor: str, address: str | None, workers: int | None, limits: Limits, threads: int) -> Fitting:
    """Returns what makes the fits of a run."""
    from dlobench.bench.run import one_by_one
    from dlobench.bench.spread import spread
    from dlobench.data.executors import find_executor

    if executor not in ("local", "ray"):
        raise UsageError(f"--executor {executor!r} makes no fits; there are: local, ray")
    chosen = find_executor(executor, workers=workers, address=address)
    return one_by_one if executor == "local" else spread(chosen, limits, threads=threads)


def _check_out(out: Path, max_minutes: float | None) -> None:
    """Raises for what would only show after the fit."""
    from dlobench.bench import results

    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out} is not a folder")
    if out.is_dir():
        results.read_all(out)  # a foreign file would spoil the board
    if max_minutes is not None and not (math.isfinite(max_minutes) and max_minutes > 0):
        raise UsageError(f"--max-minutes {max_minutes:g} is not a finite number of minutes above 0")


def _command() -> str:
    """Returns the command that was given, as records hold it: without the folders of this machine."""
    kept, words = ["dlobench"], iter(sys.argv[1:])
    for word in words:
        if word in ("--data", "--out"):
            next(words, None)
        elif not word.startswith(("--data=", "--out=")):
            kept.append(word)
    return shlex.join(kept).encode(errors="backslashreplace").decode()
