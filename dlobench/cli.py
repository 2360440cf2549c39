"""Speaks the command line: verbs only. What a verb needs is imported when it is called, so that help is instant."""

from __future__ import annotations

import errno
import io
import os
import shlex
import signal
import sys
import traceback
from typing import Annotated

import typer

from dlobench import __version__
from dlobench.cli_board import leaderboard_app
from dlobench.cli_compare import compare
from dlobench.cli_data import data_app, generate
from dlobench.cli_look import list_app
from dlobench.cli_new import new_app
from dlobench.cli_render import render
from dlobench.cli_run import MemoryLimit, TimeLimit, run, submit
from dlobench.cli_validate import validate
from dlobench.cli_verify import leaderboard_add, leaderboard_verify
from dlobench.errors import RunError, UsageError

app = typer.Typer(
    help="A benchmark of models of deformable-object dynamics.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(list_app, name="list")
app.add_typer(data_app, name="data")
app.add_typer(leaderboard_app, name="leaderboard")
app.add_typer(new_app, name="new")
leaderboard_app.command("verify")(leaderboard_verify)
leaderboard_app.command("add")(leaderboard_add)
app.command()(run)
app.command()(submit)
app.command()(generate)
app.command()(compare)
app.command()(render)
app.command()(validate)


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


@app.command()
def check(
    path: Annotated[str, typer.Argument(metavar="PATH", help="A model plugin: its file or name.")],
    time_limit: TimeLimit = 600.0,
    memory_limit: MemoryLimit = None,
) -> None:
    """Check that a plugin keeps the contract, on a tiny set, in seconds."""
    from dlobench.bench.contract import check as outcomes
    from dlobench.bench.limits import limits
    from dlobench.bench.sandbox import Sandbox

    failed, allowed = 0, limits(time_limit, memory_limit)
    with Sandbox(allowed) as sandbox, Sandbox(allowed) as another:
        plugin = sandbox.load(path)
        for outcome in outcomes(plugin, lambda: another.load(path)):
            typer.echo(
                f"{'ok    ' if outcome.passed else 'FAILED'}  {outcome.name}{outcome.why and ': ' + outcome.why}"
            )
            failed += not outcome.passed
        typer.echo(f"the plugin ran in a process of its own: {'; '.join(plugin.protection)}")
    if failed:
        raise RunError(f"{path} breaks the contract in {failed} point{'s' * (failed > 1)}")


def _fail(message: str) -> None:
    typer.echo(f"dlobench: {' '.join(message.split())}", err=True)


def main() -> None:
    """Runs the command line. Exit codes: 0 done, 1 a run failed, 2 bad usage, 130 interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Unicode still gets its table
    interrupts = list[int]()

    def interrupt(number: int, _frame: object) -> None:
        interrupts.append(number)  # an import that is interrupted may raise something else than this
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    try:
        if "" in sys.argv:  # as an unset variable of a shell gives it: `--data ""` would be the folder one is in
            raise UsageError(
                f"{sys.argv[sys.argv.index('') - 1]} is followed by nothing; give it a value or leave it away"
            )
        code = app(standalone_mode=False) or 0
    except (UsageError, RunError) as error:
        if os.environ.get("DLOBENCH_DEBUG"):
            traceback.print_exc()
        _fail(str(error))
        code = error.exit_code
    except KeyboardInterrupt:
        code = 130
    except OSError as error:
        if error.filename is not None or error.errno not in (errno.ENOSPC, errno.EPIPE):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is left in the buffer has nowhere to go
        if error.errno != errno.EPIPE:  # a reader that has gone, such as `head`, has seen enough
            _fail(f"cannot write what was to be printed: {error.strerror}")
        code = 1
    except Exception as error:
        # Errors of the command line itself carry what to say; they live in a private module of typer.
        format_message = getattr(error, "format_message", None)
        if interrupts:
            code = 130
        elif format_message is None:
            raise
        else:
            message = format_message()
            if "\n" in message:  # the help of a command that was called without arguments
                typer.echo(message, err=True)
            else:
                _fail(f"{message} (in: {shlex.join(sys.argv[1:])})")
            code = 2
    if code == 130:
        _fail("interrupted; shards and records are kept, and the same command goes on from them")
    sys.exit(code)
