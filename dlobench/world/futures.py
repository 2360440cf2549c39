"""Simulates what else could have happened: the same commands from the same state, executed again and again.

The execution noise is drawn anew each time, so the ends are samples of the true distribution over futures (paper,
section 2.3: "separate test sets to compare generative model predictions against distributions over future states").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dlobench import ranges
from dlobench.domain import Domain
from dlobench.errors import RunError
from dlobench.trajectories import Trajectories
from dlobench.world import actions, starts
from dlobench.world.simulate import PUSHES, RETRIES, Account, Simulator, Streams, record
from dlobench.world.state import Array, State, stack

EXECUTION_STREAM = 3  # re-executions have noise of their own, after a trajectory's three streams


class _Failed(Exception):
    """Says that a simulation raised, warned or pressed solids into each other."""


def futures(
    domain: Domain, seed: Sequence[int], *, sequences: int, executions: int, pushes: int
) -> tuple[Trajectories, Account]:
    """Simulates A `sequences` of commands from one state, each executed R `executions` times with fresh noise.

    The state is one of a trajectory of biased pushes, after 0 to 20 − T of them. The commands of a sequence are those
    of a trajectory that goes on from there for T `pushes`; it is not returned, since its own noise had a part in
    choosing them. Returns A R trajectories, sequence by sequence, which all begin in that state. An execution that
    fails is drawn again and counted; where one fails too often, so is the state. Raises `RunError` when every state
    fails, and `UsageError` for numbers that make no sense.
    """
    for name, value in (("sequences", sequences), ("executions", executions)):
        ranges.whole(name, value, 1)
    ranges.whole("pushes", pushes, 1, PUSHES)
    seed, failed = ranges.seed(seed), 0
    for attempt in range(RETRIES):
        try:
            recorded, account = _attempt(domain, [*seed, attempt], sequences, executions, pushes)
        except _Failed:
            failed += 1
            continue
        return recorded, Account(account.commands_redrawn, account.commands, account.trajectories_redrawn + failed)
    raise RunError(f"{RETRIES} states in a row failed from seed {seed} in {domain}")


def _attempt(
    domain: Domain, seed: Sequence[int], sequences: int, executions: int, pushes: int
) -> tuple[Trajectories, Account]:
    streams = Streams.of(seed)
    simulator = Simulator(domain, 1)
    state = simulator.reset([starts.sample(domain, streams.start)])
    lead = int(streams.start.integers(PUSHES - pushes + 1))
    redrawn = 0
    for _ in range(lead):
        state, _, more = _biased_push(simulator, state, streams)
        redrawn += more
    begin, commands = simulator.save(), np.zeros((sequences, pushes, 2))
    for sequence in commands:
        state = simulator.restore(begin)
        for step in range(pushes):
            state, sequence[step], more = _biased_push(simulator, state, streams)
            redrawn += more
    commanded = np.repeat(commands, executions, axis=0)
    noise = [np.random.default_rng([*seed, EXECUTION_STREAM, i]) for i in range(len(commanded))]
    executed, poses = commanded.copy(), dict[str, Array]()
    missing, failures = np.arange(len(commanded)), 0
    for _ in range(RETRIES):
        executed[missing] = commanded[missing] + [[actions.noise(noise[i]) for _ in range(pushes)] for i in missing]
        many = Simulator(domain, len(missing))
        again = stack([many.restore(begin), *(many.push(executed[missing, step]) for step in range(pushes))])
        poses = poses or again
        for name, values in again.items():
            poses[name][missing] = values
        missing = missing[many.failed]
        failures += len(missing)
        if not len(missing):
            break
    else:
        raise _Failed
    arrays = {**poses, "commanded": commanded, "executed": executed}
    return record(domain, arrays), Account(redrawn, lead + sequences * pushes, failures)


def _biased_push(simulator: Simulator, state: State, streams: Streams) -> tuple[State, Array, int]:
    """Executes one push as trajectories have it; returns the state, the command and how many were redrawn."""
    fixed = simulator.fixed_cylinders()
    segments = state.dlo[0, : simulator.domain.segments, :2]
    try:
        command, redrawn = actions.draw(streams.action, state.pusher[0], segments, None if fixed is None else fixed[0])
    except actions.Stuck as error:
        raise _Failed from error
    state = simulator.push((command + actions.noise(streams.noise))[None])
    if simulator.failed.any():
        raise _Failed
    return state, command, redrawn
