"""Stands in for a model that lives in the process of its plugin: the same methods, answered from there."""

from __future__ import annotations

import copy
import dataclasses
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Protocol

import numpy as np

from dlobench.bench.answers import Misdeed, counted
from dlobench.bench.model import Model, Setting
from dlobench.bench.revival import restore
from dlobench.bench.state import MANY, MOST, State, fault, flatten
from dlobench.bench.wire import Arrays, packed
from dlobench.trajectories import Prediction, Query, Trajectories

_SLACK = 8  # times the bytes of a right answer in float32, for wrong shapes to be told as such


class Asked(Protocol):
    """Asks the process of a plugin."""

    generation: int

    def ask(
        self,
        what: str,
        header: Mapping[str, Any],
        arrays: Arrays | None = None,
        *,
        generation: int | None = None,
        most: int = ...,
        log: Callable[[int, int, dict[str, float]], None] | None = None,
    ) -> tuple[dict[str, Any], Arrays]:
        """Asks for something and returns the answer."""

    def forget(self, generation: int, handle: int) -> None:
        """Lets go of a model."""


@dataclass
class Remote(Model):
    """Asks the process of its plugin whatever it is asked. Made by `remote_model`, whose fields it has."""

    process: ClassVar[Asked]

    handle: int = field(init=False, repr=False, compare=False)  # of the model there
    generation: int = field(init=False, repr=False, compare=False)  # of the process that it lives in

    def __post_init__(self) -> None:
        own = {f.name for f in dataclasses.fields(Remote)}
        hyper = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in own}
        answer, _ = self.process.ask("build", {"seed": self.seed, "device": self.device, "hyper": hyper})
        self._hold(answer)

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Fits there; what is logged there is logged here."""
        arrays: Arrays = {}
        for part, domains in (("train", train), ("valid", valid)):
            for i, domain in enumerate(domains):
                arrays |= packed(domain, f"{part}/{i}/")
        header = {
            "train": len(train),
            "valid": len(valid),
            "horizon": setting.horizon,
            "K": setting.K,
            "budget": [setting.budget.steps, setting.budget.minutes],
        }

        def log(step: int, total: int, values: dict[str, float]) -> None:
            for listener in setting.log.listeners:
                listener(step, total, values)

        self._ask("fit", header, arrays, log=log)

    def adapt(self, support: Trajectories) -> Model:
        """Returns what stands in for the adapted model; it is let go of there when it is here."""
        answer, _ = self._ask("adapt", {}, packed(support))
        if answer.get("model") == self.handle:
            return self
        adapted = copy.copy(self)
        adapted._hold(answer)
        return adapted

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the arrays that the model predicts there."""
        rows = query.dlo.shape[1] * 2 + query.bodies.shape[1] * 3
        most = 2**16 + _SLACK * 4 * len(query) * max(1, samples) * rows
        _, arrays = self._ask("predict", {"samples": samples}, packed(query), most=most)
        return Prediction(dlo=arrays.get("dlo", np.empty(0)), bodies=arrays.get("bodies"))

    def parameters(self) -> int:
        """Returns the number of learned parameters that the model counts there."""
        return counted(self._ask("parameters", {})[0].get("count"))

    def saved(self) -> State:
        """Returns what the fit has put into the model there."""
        answer, arrays = self._ask("save", {}, most=MOST + 64 * MANY)  # each array may be padded
        state = State(answer.get("tree"), arrays)
        if why := fault(state):
            raise Misdeed(f"gave a state that is none: {why}")
        return state

    @classmethod
    def restored(cls, state: State, device: str) -> Remote:
        """Returns what stands in for a model with a state, made there; seed and hyperparameters as saved."""
        model = object.__new__(cls)
        answer, _ = cls.process.ask("restore", {"tree": state.tree, "device": device}, state.arrays)
        model._hold(answer)
        given = answer.get("given")
        for name in (f.name for f in dataclasses.fields(cls) if f.init):
            if not isinstance(given, dict) or name not in given:
                raise Misdeed(f"restored a model without {name}")
            setattr(model, name, given[name])
        return model

    def _ask(self, what: str, header: Mapping[str, Any], arrays: Arrays | None = None, **how: Any) -> Any:
        return self.process.ask(what, {"model": self.handle, **header}, arrays, generation=self.generation, **how)

    def _hold(self, answer: Mapping[str, Any]) -> None:
        handle = answer.get("model")
        if type(handle) is not int:
            raise Misdeed("answered with something that is no message")
        self.handle, self.generation = handle, self.process.generation
        weakref.finalize(self, self.process.forget, self.generation, handle).atexit = False


def remote_model(process: Asked, about: Mapping[str, Any]) -> type[Model]:
    """Returns a class of stand-ins for the plugin's, of which the process has told.

    It has its name and hyperparameters, of which those `needed` lack a default, and its privilege.
    """
    hyper, needed = about["hyperparameters"], about["needed"]
    given = [(key, Any, field(default_factory=partial(copy.deepcopy, value))) for key, value in hyper.items()]
    lacking = [(key, Any, field(kw_only=True)) for key in needed]
    namespace = {"process": process, "privileged": about["privileged"] is True}
    return dataclasses.make_dataclass(str(about["class"]), [*given, *lacking], bases=(Remote,), namespace=namespace)


def state_of(model: Model) -> State:
    """Returns what a fit has put into a model, here or in the process of its plugin; raises as `flatten` does."""
    return model.saved() if isinstance(model, Remote) else flatten(model)


def revive(cls: type[Model], state: State, *, device: str) -> Model:
    """Returns a model with a state, here or in the process of its plugin; raises as `restore` does."""
    return cls.restored(state, device) if issubclass(cls, Remote) else restore(cls, state, device=device)
