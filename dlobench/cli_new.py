"""Speaks the verb `dlobench new model`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

new_app = typer.Typer(help="Write a plugin to begin with.", no_args_is_help=True)


@new_app.callback()
def _group() -> None:
    pass


@new_app.command("model")
def new_model(
    name: Annotated[str, typer.Argument(metavar="NAME", help="What the model is to be called: its file is NAME.py.")],
) -> None:
    """Write a model plugin to begin with: a linear model of some 30 lines, without PyTorch, that keeps the contract."""
    from dlobench.bench import template

    path = template.write(name, Path())
    typer.echo(f"{path}: `dlobench check {path}`, then `dlobench run --task meta --model {path}`")
