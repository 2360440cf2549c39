"""Asks about one domain: what a model sees of it, how far ahead it is to tell, and what really happened."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dlobench.bench.task import Fit, Noise, Scale, Task, supports
from dlobench.trajectories import Floats, Mask, Prediction, Query, Trajectories


@dataclass(frozen=True)
class Question:
    """Holds B queries of one domain, and the truth after some of their actions."""

    query: Query  # as it is measured
    start: Floats  # (B, 32, 2)  m, where the segments really were
    truths: Mapping[int, Prediction]  # by pushes ahead; M true samples


@dataclass(frozen=True)
class Domain:
    """Holds one domain to be tested on."""

    name: str  # set/index
    cell: str  # of the set
    seen: Trajectories  # as they are measured: supports, then queries
    question: Question
    pool: int  # trajectories that supports are drawn from

    def supports(self, K: int) -> Iterator[Trajectories]:
        """Yields disjoint supports of K trajectories."""
        yield from (self.seen.take(chosen) for chosen in supports(self.pool, K))


def domain(name: str, cell: str, trajectories: Trajectories, *, task: Task, scale: Scale, fit: Fit) -> Domain:
    """Returns what a fit is tested on in one domain, out of the trajectories that the task reads there."""
    if task.futures is not None:
        question = _futures(trajectories, fit.horizon, task.set_of("test").executions)
        return Domain(name, cell, trajectories.take(slice(0)), question, 0)
    seen = measured(trajectories, task.noise, name)
    queries = slice(scale.support, scale.support + scale.query)
    question = asked(seen.take(queries), trajectories.take(queries), task.ahead(fit))
    return Domain(name, cell, seen, question, scale.support)


def asked(seen: Trajectories, true: Trajectories, ahead: tuple[int, ...]) -> Question:
    """Asks about every window of the farthest horizon, and about the nearer ones on the way."""
    farthest = max(ahead)
    (query, _), (start, _) = seen.windows(farthest), true.windows(farthest)
    return Question(query, start.dlo[..., :2], {n: _later(true, n, farthest) for n in ahead})


def _later(true: Trajectories, n: int, farthest: int) -> Prediction:
    """Returns the state after n pushes of every window of `farthest` pushes."""
    starts = true.pushes - farthest + 1
    ends = slice(n, n + starts)
    dlo, bodies = true.dlo[:, ends, :, :2], true.bodies[:, ends]
    return Prediction(dlo=dlo.reshape(1, -1, *dlo.shape[2:]), bodies=bodies.reshape(1, -1, *bodies.shape[2:]))


def _futures(trajectories: Trajectories, n: int, executions: int) -> Question:
    """Asks about n commands from the states that trajectories begin in, each executed many times."""
    first = trajectories.take(np.arange(0, len(trajectories), executions))
    query = Query(
        dlo=first.dlo[:, 0],
        dlo_mask=first.dlo_mask,
        pusher=first.pusher[:, 0],
        bodies=first.bodies[:, 0],
        body_mask=first.body_mask,
        boxes=first.boxes,
        actions=first.commanded[:, :n],
        parameters=first.parameters,
    )

    def samples(rows: Floats) -> Floats:
        return rows.reshape(-1, executions, *rows.shape[1:]).swapaxes(0, 1)

    truth = Prediction(dlo=samples(trajectories.dlo[:, n, :, :2]), bodies=samples(trajectories.bodies[:, n]))
    return Question(query, query.dlo[..., :2], {n: truth})


def commanded(trajectories: Trajectories) -> Trajectories:
    """Returns trajectories whose actions are the commands, where what was executed is not to be seen."""
    return replace(trajectories, executed=trajectories.commanded)


def measured(trajectories: Trajectories, noise: Noise | None, name: str) -> Trajectories:
    """Returns trajectories as imperfect measurements have them, the same for every model: of a domain by its name.

    The errors of segments, bodies and moments are independent and normal; the pusher is a robot's, and known.
    """
    if noise is None:
        return trajectories
    seed = hashlib.sha256(f"measured\0{name}".encode()).digest()
    std = np.array([noise.position, noise.position, noise.yaw], np.float32)

    def noisy(poses: Floats, exists: Mask, what: int) -> Floats:
        draws = [
            np.random.default_rng([*np.frombuffer(seed, np.uint32), what, k]).standard_normal(rows.shape, np.float32)
            for k, rows in enumerate(poses)
        ]
        out: Floats = poses + np.array(draws, np.float32).reshape(poses.shape) * std * exists[:, None]
        return out

    dlo = noisy(trajectories.dlo, trajectories.dlo_mask, 0)
    return replace(trajectories, dlo=dlo, bodies=noisy(trajectories.bodies, trajectories.body_mask, 1))
