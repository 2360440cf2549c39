"""Shows things in a terminal: progress bars, tables, lines. Results go to stdout, everything else to stderr."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from dlobench.nn.budget import Listener


class _Rate(ProgressColumn):
    """Shows units a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.3g} {task.fields['unit']}/s", style="cyan")


class TerminalReporter:
    """Tells the user how a run goes, on stderr."""

    def __init__(self) -> None:
        self._console = Console(stderr=True, highlight=False)

    def say(self, text: str) -> None:
        """Says one line."""
        self._console.print(text, soft_wrap=True, markup=False)

    @contextmanager
    def bar(self, title: str, unit: str) -> Iterator[Listener]:
        """Shows a bar with rate, ETA and the latest values; where there is no terminal, a line at the end."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[unit]}"),
            _Rate(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[values]}", markup=False),
        )
        with Progress(*columns, console=self._console) as progress:
            bar = progress.add_task(title, total=None, unit=unit, values="")

            def listen(done: int, total: int, values: dict[str, float]) -> None:
                text = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
                progress.update(bar, completed=done, total=total, values=text)

            yield listen


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Prints a table to stdout, whole however narrow the terminal."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in header:
        table.add_column(name, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    Console(highlight=False, markup=False, width=10_000).print(table)
