"""Defines what a model plugin is: `fit` once, `adapt` to a domain, `predict`. NumPy at the border."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar

from dlobench.nn.budget import Budget, Log
from dlobench.trajectories import Prediction, Query, Trajectories


@dataclass(frozen=True)
class Setting:
    """Says what a fit is for."""

    horizon: int  # n, pushes ahead
    K: tuple[int, ...]  # the support sizes, in trajectories, that it will be scored at
    budget: Budget = field(default_factory=Budget)
    log: Log = field(default_factory=Log)


@dataclass
class Model(ABC):
    """Describes a dynamics model. Subclasses are dataclasses; their fields are the hyperparameters.

    A plugin file defines exactly one subclass. It is built with a seed and a device, then fitted once; a run builds one
    more beforehand, so that `__post_init__` can refuse hyperparameters before there are data.
    The same seed and data give the same predictions on a CPU.
    """

    privileged: ClassVar[bool] = False  # sees the parameters of domains, in `Trajectories` and `Query`; unranked
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = MappingProxyType({})  # hyperparameters by --set preset=NAME

    seed: int = 0
    device: str = "cpu"  # "cpu" or "cuda"

    @abstractmethod
    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns from the training domains, one `Trajectories` each; `valid` holds domains to stop or choose by."""

    def adapt(self, support: Trajectories) -> Model:
        """Returns a model for the domain that `support` came from; never changes self."""
        return self

    @abstractmethod
    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the state after the query's actions: S = 1 if deterministic, else `samples`."""

    def parameters(self) -> int:
        """Returns the number of learned parameters, 0 for a model that learns none."""
        return 0
