"""Offers the sets to torchrl as a replay buffer: `load_dataset("dlobench:meta-learning-mini")`.

Importing this module tells torchrl's registry of them, since torchrl knows no other way; nothing else in dlobench does,
so that torch is loaded by those alone who ask for it. Frames are in torchrl's episode data format (TED), under the
names that `dlobench.world.env.make_torchrl_env` uses, float32 and SI.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict  # type: ignore[import-untyped]
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, Storage  # type: ignore[import-untyped]
from torchrl.data.datasets import register_dataset  # type: ignore[import-untyped]
from torchrl.data.datasets.common import BaseDatasetExperienceReplay  # type: ignore[import-untyped]

from dlobench.data.domain_set import PARTS
from dlobench.data.minibatches import STATE, Minibatches
from dlobench.data.reading import Reading, load
from dlobench.data.sets import SETS, find
from dlobench.data.store import COLUMNS, Rows, Store
from dlobench.domain import MAX_BODIES, MAX_SEGMENTS
from dlobench.errors import RunError, UsageError

PREFIX = "dlobench"
_COMMANDED = STATE + COLUMNS["cylinder"]  # the first column of what was asked for


class Frames(Storage):  # type: ignore[misc]  # torchrl is untyped
    """Holds the pushes of mapped trajectories as frames, domain by domain; they are copied when they are asked for."""

    def __init__(self, trajectories: Reading) -> None:
        self._pushes = Minibatches({domain: trajectories.rows(domain) for domain in trajectories}, horizon=1)
        super().__init__(len(self._pushes))

    def __len__(self) -> int:
        return len(self._pushes)

    def get(self, index: int | slice | range | list[int] | Tensor | NDArray[np.intp] | tuple[Any, ...]) -> TensorDict:
        """Returns frames by number, in the shape of the index."""
        if isinstance(index, tuple) and len(index) == 1:
            return self.get(index[0])
        if isinstance(index, slice):
            numbers = np.arange(*index.indices(len(self)))
        else:
            given = np.asarray(index)
            numbers = np.flatnonzero(given) if given.dtype == bool else given.astype(np.intp)
        wrong = (numbers < -len(self)) | (numbers >= len(self))
        if wrong.any():
            raise IndexError(f"frame {numbers[wrong][0]} is asked for, there are {len(self)}")
        return self._frames(numbers.ravel() % len(self)).reshape(numbers.shape)

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        """Refuses."""
        raise RuntimeError(ImmutableDatasetWriter.WRITING_ERR)

    def state_dict(self) -> dict[str, Any]:
        """Returns nothing: the frames are on disk."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Does nothing: the frames are on disk."""

    def dumps(self, path: Any) -> None:
        """Does nothing: the frames are on disk."""

    def loads(self, path: Any) -> None:
        """Does nothing: the frames are on disk."""

    def _empty(self) -> None:
        raise RuntimeError(ImmutableDatasetWriter.WRITING_ERR)

    def _frames(self, numbers: NDArray[np.intp]) -> TensorDict:
        before, executed, after, domain = self._pushes.rows(numbers)
        trajectory, step = np.divmod(numbers, self._pushes.starts)
        previous = self._pushes.rows(numbers - (step > 0))[1]
        previous[step == 0] = 0  # nothing was executed before the first push
        size, last = [len(numbers)], torch.from_numpy(step == self._pushes.pushes - 1)[:, None]
        never = torch.zeros_like(last)
        following = _observation(after, executed) | {
            "reward": torch.zeros(len(numbers), 1),
            "done": last,
            "truncated": last.clone(),
            "terminated": never.clone(),
        }
        frames: dict[str, Any] = _observation(before, previous) | {
            "action": torch.from_numpy(before[:, _COMMANDED : _COMMANDED + 2]),
            "done": never,
            "truncated": never.clone(),
            "terminated": never.clone(),
            "trajectory": torch.from_numpy(trajectory),
            "domain": torch.from_numpy(domain),
            "next": TensorDict(following, size),
        }
        return TensorDict(frames, size)


class DLOExperienceReplay(BaseDatasetExperienceReplay):  # type: ignore[misc]  # torchrl is untyped
    """Samples single pushes of a part of a set, memory-mapped: what is not sampled is not read, nothing is kept twice.

    A frame holds the observation (`dlo`, `pusher`, `bodies`, and `executed`, the displacement that led to it), the
    `action` that was commanded, and under `next` the observation after it; `trajectory` runs through all that is
    loaded, `domain` is the number in the set. An episode is cut at its end, never terminated; rewards are 0.

    Args:
        dataset_id: `<set>-<scale>`, as in `meta-learning-mini`.
        batch_size: frames that `sample()` returns.
        part: train, valid or test.
        root: the data folder, by default $DLOBENCH_DATA, else the platform's cache.
        **options: `sampler`, `transform`, `prefetch` and what else `TensorDictReplayBuffer` takes. Whole stretches are
            had by `SliceSampler(slice_len=4, traj_key="trajectory", cache_values=True)`.

    Raises:
        UsageError: where there is no such set, scale or part.
        RunError: where trajectories are still to be generated; it names the command.

    """

    available_datasets = tuple(f"{of.name}-{scale}" for of in SETS.values() for scale in of.extents)

    def __init__(
        self,
        dataset_id: str,
        batch_size: int | None = None,
        *,
        part: str = "train",
        root: str | os.PathLike[str] | None = None,
        **options: Any,
    ) -> None:
        if dataset_id not in self.available_datasets:
            raise UsageError(f"unknown data set {dataset_id!r}; there are: {', '.join(self.available_datasets)}")
        name, _, scale = dataset_id.rpartition("-")
        self.dataset_id, self.part = dataset_id, part
        self.root = Store.open(root).root
        self._folder = find(name).key
        self.domains, trajectories = load(name, scale, part, root)  # a row a domain, by its number
        options = {"writer": ImmutableDatasetWriter(), "collate_fn": _as_it_is, **options}
        super().__init__(storage=Frames(trajectories), batch_size=batch_size, **options)

    @property
    def data_path_root(self) -> Path:
        """Returns the folder of the set."""
        return Path(self.root) / self._folder

    @property
    def data_path(self) -> Path:
        """Returns the folder of the set, which all scales and parts share."""
        return self.data_path_root

    def delete(self) -> None:
        """Refuses: other parts and scales are of the same shards."""
        raise RunError(f"{self.data_path} is shared by {', '.join(PARTS)} and all scales; remove it by hand")

    def _is_downloaded(self) -> bool:
        return True  # or there would be no buffer


def _as_it_is(frames: TensorDict) -> TensorDict:
    """Collates frames, which a storage gives together already."""
    return frames


def _observation(rows: Rows, executed: NDArray[np.complex64]) -> dict[str, Tensor]:
    """Returns what is seen in rows (B, 114), after displacements (B, 1) were executed."""
    state = torch.from_numpy(rows)[:, :STATE]
    pusher, dlo, bodies = torch.split(state, [COLUMNS["pusher"], COLUMNS["dlo"], COLUMNS["bodies"]], dim=1)
    return {
        "dlo": dlo.reshape(-1, MAX_SEGMENTS, 3),
        "pusher": pusher,
        "bodies": bodies.reshape(-1, MAX_BODIES, 3),
        "executed": torch.from_numpy(executed.view(np.float32)),
    }


register_dataset(PREFIX, DLOExperienceReplay, replace=True)
