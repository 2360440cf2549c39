"""Speaks the verb that draws: `dlobench render`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from dlobench.cli_look import Data, open_store
from dlobench.errors import RunError, UsageError


def render(
    domain: Annotated[str, typer.Option(metavar="SET/INDEX", help="A domain of a set, such as meta-learning/17.")],
    trajectory: Annotated[int, typer.Option(help="A trajectory of the domain, from 0.")],
    out: Annotated[Path, typer.Option(help="Picture (.png) or film (.gif, .mp4) to write.")],
    push: Annotated[int | None, typer.Option(help="A picture's state: after so many pushes. Default: all.")] = None,
    depth: Annotated[bool, typer.Option("--depth", help="Draw depth; a .png holds it in units of 0.1 mm.")] = False,
    camera: Annotated[str, typer.Option(help="top or oblique.")] = "top",
    style: Annotated[str, typer.Option(metavar="NAME|FILE", help="paper, dark, wood, or a .toml file.")] = "paper",
    data: Data = None,
) -> None:
    """Draw a recorded trajectory: one state as a picture, or every state, a quarter of a second each, as a film."""
    from dlobench.data.address import parse
    from dlobench.data.store import atomic_write
    from dlobench.world import canvas, pictures
    from dlobench.world import style as styles

    kind = out.suffix.lower()
    if kind not in pictures.SUFFIXES or out.is_dir():
        raise UsageError(f"--out {str(out)!r} does not name a file of the kinds {', '.join(pictures.SUFFIXES)}")
    if push is not None and kind != ".png":
        raise UsageError(f"--push {push} chooses the state of a .png; a {kind} shows every state")
    store, address = open_store(data), parse(domain, trajectory)
    pushes = address.of.pushes
    if push is not None and not 0 <= push <= pushes:
        raise UsageError(f"--push {push} is outside 0–{pushes}, the states of a trajectory")
    view, look = styles.find_camera(camera), styles.load(style)
    pictures.check_installed()
    if store.sidecar(address.of, address.unit) is None:
        command = address.command() + (f" --data {shlex.quote(str(data))}" if data else "")
        raise RunError(f"there is no shard {store.path(address.of, address.unit)} yet; `{command}` makes it")
    recorded = store.load(address.of, address.unit)
    canvas.load()  # before anything else imports MuJoCo, whose import fails where MUJOCO_GL names what is not there
    from dlobench.world.render import frames

    states = [pushes if push is None else push] if kind == ".png" else list(range(pushes + 1))
    drawn = frames(
        address.of.domain(address.domain),
        dlo=recorded.dlo[address.row, states],
        pusher=recorded.pusher[address.row, states],
        bodies=recorded.bodies[address.row, states],
        cylinder=None if recorded.cylinder is None else recorded.cylinder[address.row, states],
        style=look,
        camera=view,
        depth=depth,
    )
    atomic_write(out, pictures.encode(list(drawn), kind))
    typer.echo(f"{out}: {len(states)} state{'s' * (len(states) > 1)} of {domain}, trajectory {trajectory}")
