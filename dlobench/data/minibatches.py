"""Draws minibatches of windows from the rows of many trajectories, in memory or mapped, at the speed of copying."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench import ranges
from dlobench.data.store import COLUMNS, WIDTH, Rows
from dlobench.domain import MAX_BODIES, MAX_SEGMENTS
from dlobench.errors import UsageError

Numbers = NDArray[np.intp]

STATE = COLUMNS["pusher"] + COLUMNS["dlo"] + COLUMNS["bodies"]  # 107, the columns of a state; they come first
CHUNK = 512  # windows of each domain that are gathered at once and handed out in minibatches; a cache holds them
MOST = 16_384  # windows of all domains that are; 15 MB


@dataclass(frozen=True)
class Minibatch:
    """Holds B windows: a state, the n displacements executed from it, and the state after them. SI, float32.

    Arrays of NumPy, or tensors of torch after `torch()`. A state is the pusher 2, segments 96 and bodies 9, flat.
    """

    state: Any  # (B, 107)
    actions: Any  # (B, n, 2)  executed displacements of the pusher, m
    after: Any  # (B, 107)  the state n pushes later
    domain: Any  # (B,)  number of the domain of each window, int64

    def __len__(self) -> int:
        return len(self.state)

    @property
    def pusher(self) -> Any:
        """Returns the pusher before, (B, 2) x m, y m."""
        return _pusher(self.state)

    @property
    def dlo(self) -> Any:
        """Returns the segments before, (B, 32, 3) x m, y m, yaw rad; padding is 0."""
        return _dlo(self.state)

    @property
    def bodies(self) -> Any:
        """Returns the rigid bodies before, (B, 3, 3) x m, y m, yaw rad; padding is 0."""
        return _bodies(self.state)

    @property
    def pusher_after(self) -> Any:
        """Returns the pusher after, (B, 2) x m, y m."""
        return _pusher(self.after)

    @property
    def dlo_after(self) -> Any:
        """Returns the segments after, (B, 32, 3) x m, y m, yaw rad; padding is 0."""
        return _dlo(self.after)

    @property
    def bodies_after(self) -> Any:
        """Returns the rigid bodies after, (B, 3, 3) x m, y m, yaw rad; padding is 0."""
        return _bodies(self.after)

    def torch(self) -> Minibatch:
        """Returns the windows as tensors, which share the memory of the arrays."""
        import torch

        return Minibatch(**{name: torch.from_numpy(rows) for name, rows in vars(self).items()})


class Minibatches:
    """Draws windows of `horizon` pushes, which are numbered domain by domain in the order of `Trajectories.windows`.

    Holds nothing but references to the rows, (K, T+1, 114) of each domain; what is drawn is a copy.
    """

    def __init__(self, rows: Mapping[int, Rows], *, horizon: int) -> None:
        """Raises `UsageError` for no rows, rows that differ in pushes, or a horizon that does not fit into them."""
        lengths = {each.shape[1] for each in rows.values()}
        if len(lengths) != 1:
            raise UsageError(f"rows of {len(rows)} domains have {sorted(lengths)} states a trajectory, not one number")
        self.pushes = lengths.pop() - 1
        self.horizon = ranges.whole("horizon", horizon, 1, self.pushes)
        self.starts = self.pushes - self.horizon + 1  # windows a trajectory
        self._domains = np.fromiter(rows, np.int64, len(rows))
        self._flat = [_flat(each) for each in rows.values()]
        self._first = np.cumsum([0, *(len(each) * self.starts for each in rows.values())])  # window of each domain

    def __len__(self) -> int:
        """Returns the number of windows."""
        return int(self._first[-1])

    def take(self, windows: Numbers) -> Minibatch:
        """Returns the windows of these numbers, 0 to len − 1, in their order."""
        windows = np.asarray(windows, np.intp)
        if windows.size and not 0 <= windows.min() <= windows.max() < len(self):
            raise UsageError(f"windows {windows.min()} to {windows.max()} are not all within 0 to {len(self) - 1}")
        return self._gather(windows)

    def draw(self, size: int, rng: np.random.Generator) -> Minibatch:
        """Returns `size` windows, each drawn from all."""
        return self._gather(rng.integers(len(self), size=ranges.whole("size", size, 1)))

    def epoch(self, size: int, rng: np.random.Generator) -> Iterator[Minibatch]:
        """Yields every window once, in minibatches of `size`; the last may be smaller.

        Each of `starts` passes takes another window of every trajectory, in a new random order: neighbours in a
        minibatch are of different trajectories, and what is kept in memory does not grow with the windows.
        """
        most = min(CHUNK * len(self._flat), MOST)
        length = max(most // ranges.whole("size", size, 1), 1) * size
        for windows in self._chunks(length, rng):
            chunk = self._gather(windows)
            for first in range(0, len(windows), size):
                part = slice(first, first + size)
                yield Minibatch(chunk.state[part], chunk.actions[part], chunk.after[part], chunk.domain[part])

    def _chunks(self, length: int, rng: np.random.Generator) -> Iterator[Numbers]:
        """Yields the numbers of all windows, `length` at a time."""
        trajectories = len(self) // self.starts
        offset, held = rng.integers(self.starts, size=trajectories), np.empty(0, np.intp)
        for shift in rng.permutation(self.starts):
            order = rng.permutation(trajectories)
            held = np.concatenate([held, order * self.starts + (offset[order] + shift) % self.starts])
            whole = len(held) - len(held) % length
            yield from (held[first : first + length] for first in range(0, whole, length))
            held = held[whole:]
        if held.size:
            yield held

    def rows(self, windows: Numbers) -> tuple[Rows, NDArray[np.complex64], Rows, NDArray[np.int64]]:
        """Returns what is on disk of windows of these numbers: for those who need more of it than a `Minibatch` has.

        The row they begin with (B, 114), their executed displacements as pairs (B, n), the row after them (B, 114),
        and the number of their domain (B,).
        """
        B, n = len(windows), self.horizon
        before, after = np.empty((2, B, WIDTH), np.float32)
        pairs = np.empty((B, n), np.complex64)  # a displacement is one item to copy
        if len(self._flat) == 1:
            self._copy(0, windows, before, pairs, after)
            return before, pairs, after, np.full(B, self._domains[0])
        source = np.searchsorted(self._first, windows, "right") - 1
        order, counts = np.argsort(source, kind="stable"), np.bincount(source, minlength=len(self._flat))
        ends, later, place = np.cumsum(counts), windows[order], np.empty(B, np.intp)
        place[order] = np.arange(B)
        grouped, held = np.empty((2, B, WIDTH), np.float32), np.empty_like(pairs)
        for number in np.flatnonzero(counts).tolist():
            part = slice(ends[number] - counts[number], ends[number])
            self._copy(number, later[part] - self._first[number], grouped[0, part], held[part], grouped[1, part])
        for copied, wanted in ((grouped[0], before), (held, pairs), (grouped[1], after)):
            copied.take(place, axis=0, out=wanted, mode="clip")
        return before, pairs, after, self._domains[source]

    def _gather(self, windows: Numbers) -> Minibatch:
        """Copies windows out of the rows."""
        before, pairs, after, domain = self.rows(windows)
        actions = pairs.view(np.float32).reshape(len(windows), self.horizon, 2)
        return Minibatch(before[:, :STATE], actions, after[:, :STATE], domain)

    def _copy(self, number: int, windows: Numbers, before: Rows, pairs: NDArray[np.complex64], after: Rows) -> None:
        """Copies windows of one domain; `clip` lets NumPy write straight into the outputs."""
        rows = self._flat[number]
        first = windows + windows // self.starts * self.horizon  # a trajectory has `horizon` more states than windows
        rows.take(first, axis=0, out=before, mode="clip")
        rows.take(first + self.horizon, axis=0, out=after, mode="clip")
        if self.horizon == 1:  # the executed displacement is the last pair of a row
            pairs[:, 0] = before.view(np.complex64)[:, -1]
        else:
            steps = (first[:, None] + np.arange(self.horizon)) * (WIDTH // 2) + (WIDTH // 2 - 1)
            rows.view(np.complex64).reshape(-1).take(steps, out=pairs, mode="clip")


def _pusher(state: Any) -> Any:
    return state[:, :2]


def _dlo(state: Any) -> Any:
    return state[:, 2 : STATE - 3 * MAX_BODIES].reshape(-1, MAX_SEGMENTS, 3)


def _bodies(state: Any) -> Any:
    return state[:, STATE - 3 * MAX_BODIES :].reshape(-1, MAX_BODIES, 3)


def _flat(rows: Rows) -> Rows:
    """Views rows (K, T+1, 114) as (K (T+1), 114); raises `UsageError` for what is laid out in another way."""
    if (
        rows.dtype != np.float32
        or rows.ndim != 3
        or rows.shape[2] != WIDTH
        or not rows.flags.c_contiguous
        or not rows.size
    ):
        raise UsageError(
            f"{rows.dtype} {rows.shape} is not a contiguous float32 array (K, T+1, {WIDTH}) of rows, K > 0"
        )
    return np.asarray(rows).reshape(-1, WIDTH)
