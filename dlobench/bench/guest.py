"""Runs in the process of a plugin: confines itself, loads the plugin, and does what the run asks it over a socket.

Started as `python -m dlobench.bench.guest SOCKET`. The first process stays outside of the confinement and runs nothing
of the plugin: it is the parent that orphans come back to, and ends them all when the run dies.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import sys
import traceback
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, get_type_hints

from dlobench.bench.confinement import confine
from dlobench.bench.landlock import checked, libc
from dlobench.bench.processes import end_descendants

if TYPE_CHECKING:
    from dlobench.bench.model import Model
    from dlobench.bench.wire import Arrays, Wire

FOLDER = "dlobench-plugin-"  # how the name of the folder begins that a plugin works in
_PARENT_DEATH_SIGNAL, _SUBREAPER = 1, 36  # of prctl(2)


def main() -> None:
    """Starts the process that serves, and waits for it; ends all that descends from it when the run has gone."""
    signal.signal(signal.SIGTERM, lambda *_: _leave(128 + signal.SIGTERM))
    _control(_SUBREAPER, 1)
    _control(_PARENT_DEATH_SIGNAL, signal.SIGTERM)
    guest = os.fork()
    if not guest:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        _serve(socket.socket(fileno=int(sys.argv[1])))
        return
    os.close(int(sys.argv[1]))
    pid, status = 0, 0
    while pid != guest:  # and whatever orphan comes back
        pid, status = os.wait()
    code = os.waitstatus_to_exitcode(status)
    _leave(code if code >= 0 else 128 - code)  # as shells say it


def _control(option: int, value: int) -> None:
    """Sets an attribute of this process; elsewhere than on Linux there is none of them."""
    if sys.platform == "linux":
        checked(libc.prctl(option, value, 0, 0, 0), "prctl")


def _leave(code: int) -> NoReturn:
    """Ends all that descends from this process, then it, and removes the folder that the plugin worked in."""
    end_descendants(os.getpid())
    if Path.cwd().name.startswith(FOLDER):
        shutil.rmtree(Path.cwd(), ignore_errors=True)
    os._exit(code)


def _serve(sock: socket.socket) -> None:
    from dlobench.bench.wire import Wire

    wire = Wire(sock)
    asked, _ = wire.receive()
    cage = asked["confine"]
    force = confine(
        hidden=[Path(path) for path in cage["hidden"]],
        needed=[Path(path) for path in cage["needed"]],
        folder=Path(cage["folder"]),
        memory=cage["memory"],
        tasks=cage["tasks"],
    )
    # What a plugin's process may be told to do starts here; before, nothing of the plugin has run.
    _control(_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    wire.send({"ask": asked["ask"], "done": True, "force": force})
    guest, here = Guest(wire), os.getpid()
    while True:
        try:
            asked, arrays = wire.receive()
        except EOFError:
            return
        try:
            header, reply = guest.answer(asked, arrays)
        except BaseException as error:  # KeyboardInterrupt too: a real one is not sent here
            header, reply = _blamed(error), {}
        if os.getpid() != here:
            os._exit(0)  # a fork that the plugin let go on: it has nothing to say
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):  # a plugin may have closed or replaced it
                stream.flush()
        wire.send({"ask": asked["ask"], "done": True, **header}, reply)


def _blamed(error: BaseException) -> dict[str, Any]:
    """Says what went wrong: an error of ours with its kind, and anything else by what the plugin did."""
    from dlobench.bench.answers import Misdeed, blame
    from dlobench.errors import RunError, UsageError

    kinds = {Misdeed: "misdeed", UsageError: "usage", RunError: "run"}
    kind = next((word for cls, word in kinds.items() if isinstance(error, cls)), None)
    said = str(error) if kind else blame(error)
    trace = "".join(traceback.format_exception(error))
    return {"error": kind or "misdeed", "said": said[:2000], "trace": trace[-20_000:]}


class Guest:
    """Holds a plugin and the models made of it, and answers what is asked about them."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._model: type[Model] | None = None
        self._models: dict[int, Model] = {}
        self._next = 0

    def answer(self, asked: dict[str, Any], arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        """Does what is asked and returns the header and arrays of the answer."""
        for handle in asked.get("drop", []):
            self._models.pop(handle, None)
        does = {
            "load": self._load,
            "parse": self._parse,
            "build": self._build,
            "fit": self._fit,
            "adapt": self._adapt,
            "predict": self._predict,
            "parameters": self._parameters,
            "save": self._save,
            "restore": self._restore,
        }[asked["do"]]
        answered: tuple[dict[str, Any], Arrays] = does(asked, arrays)
        return answered

    def _load(self, asked: dict[str, Any], _arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        from dlobench.bench.order import recordable
        from dlobench.bench.plugins import hyperparameters, load_model

        plugin = load_model(asked["path"])
        self._model = plugin.model
        hyper = hyperparameters(plugin.model)
        needed = [name for name, value in hyper.items() if value is MISSING]
        given = recordable({name: value for name, value in hyper.items() if value is not MISSING})
        model = plugin.model
        about = {"class": model.__name__, "sha256": plugin.sha256, "privileged": bool(model.privileged)}
        return {**about, "hyperparameters": given, "needed": needed}, {}

    def _parse(self, asked: dict[str, Any], _arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        from dlobench.bench.order import recordable
        from dlobench.bench.plugins import parse_settings

        return {"settings": recordable(parse_settings(self._plugin(), asked["texts"]))}, {}

    def _build(self, asked: dict[str, Any], _arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        model = self._plugin()
        return self._keep(model(seed=asked["seed"], device=asked["device"], **_typed(model, asked["hyper"]))), {}

    def _fit(self, asked: dict[str, Any], arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        from dlobench.bench.model import Setting
        from dlobench.bench.wire import unpacked
        from dlobench.nn.budget import Budget, Log
        from dlobench.trajectories import Trajectories

        def tell(step: int, total: int, values: dict[str, float]) -> None:
            self._wire.send({"log": [int(step), int(total), {name: float(value) for name, value in values.items()}]})

        train, valid = (
            [unpacked(Trajectories, arrays, f"{part}/{i}/") for i in range(asked[part])] for part in ("train", "valid")
        )
        setting = Setting(asked["horizon"], tuple(asked["K"]), Budget(*asked["budget"]), Log([tell]))
        self._models[asked["model"]].fit(train, valid, setting)
        return {}, {}

    def _adapt(self, asked: dict[str, Any], arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        from dlobench.bench.answers import Misdeed, watched
        from dlobench.bench.model import Model
        from dlobench.bench.wire import unpacked
        from dlobench.trajectories import Trajectories

        model = self._models[asked["model"]]
        with watched(arrays, "support"):
            adapted: object = model.adapt(unpacked(Trajectories, arrays))
        if not isinstance(adapted, Model):
            raise Misdeed(f"returned {type(adapted).__name__}, a Model was asked for")
        return ({"model": asked["model"]} if adapted is model else self._keep(adapted)), {}

    def _predict(self, asked: dict[str, Any], arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        from dlobench.bench.answers import plain, watched
        from dlobench.bench.wire import unpacked
        from dlobench.trajectories import Query

        query: Query = unpacked(Query, arrays)
        with watched(arrays, "query"):
            prediction = self._models[asked["model"]].predict(query, asked["samples"])
        return {}, plain(prediction, query)

    def _parameters(self, asked: dict[str, Any], _arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        from dlobench.bench.answers import counted

        return {"count": counted(self._models[asked["model"]].parameters())}, {}

    def _save(self, asked: dict[str, Any], _arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        from dlobench.bench.state import flatten

        state = flatten(self._models[asked["model"]])
        return {"tree": state.tree}, state.arrays

    def _restore(self, asked: dict[str, Any], arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
        from dlobench.bench.order import recordable
        from dlobench.bench.revival import restore
        from dlobench.bench.state import State

        model = restore(self._plugin(), State(asked["tree"], arrays), device=asked["device"])
        given = recordable({f.name: getattr(model, f.name) for f in fields(model) if f.init})
        return {**self._keep(model), "given": given}, {}

    def _plugin(self) -> type[Model]:
        if self._model is None:
            raise RuntimeError("no plugin is loaded")
        return self._model

    def _keep(self, model: Model) -> dict[str, Any]:
        self._next += 1
        self._models[self._next] = model
        return {"model": self._next}


def _typed(model: type[Model], hyper: dict[str, Any]) -> dict[str, Any]:
    """Returns hyperparameters with the types that their fields have, out of what JSON made of them."""
    from pydantic import TypeAdapter

    from dlobench.bench.order import recordable
    from dlobench.bench.plugins import hyperparameters

    defaults, hints = hyperparameters(model), get_type_hints(model)
    out = {}
    for name, value in hyper.items():
        default = defaults[name]
        same = default is not MISSING and json.dumps(recordable({name: default})[name]) == json.dumps(value)
        out[name] = default if same else TypeAdapter(hints[name]).validate_python(value)
    return out


if __name__ == "__main__":
    main()
