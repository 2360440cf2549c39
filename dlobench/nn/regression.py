"""Regresses what segments do on what a query shows, by one plain network or by many that are trained as a stack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Budget, Log
from dlobench.nn.fit import CHUNK, REPORT, Course, Network, Plan, positive
from dlobench.nn.networks import Layers, detached, flat, initial, mlp, weighted_mse
from dlobench.nn.stack import Stack
from dlobench.nn.windows import COORDINATES, Frame, Target, Windows, standardise
from dlobench.trajectories import Trajectories


@dataclass(frozen=True)
class Regression:
    """Says what to regress: which network on which representation, how fast and for how long."""

    width: int
    depth: int  # hidden layers
    bodies: bool  # whether the rigid bodies are features
    target: Target
    batch: int  # windows
    plan: Plan
    frame: Frame = "world"
    normalise: bool = True
    epochs: int | None = None  # instead of the plan's patience: validates once an epoch, waits for so many

    def __post_init__(self) -> None:
        positive(self, "width", "depth", "batch", *(["epochs"] if self.epochs is not None else []))
        if self.plan.cosine or self.plan.clip is not None:
            raise UsageError("a regression has one learning rate and does not clip gradients")

    def plan_of(self, windows: int) -> Plan:
        """Returns the plan for a training set of so many windows."""
        if self.epochs is None:
            return self.plan
        return replace(self.plan, every=max(1, windows // self.batch), patience=self.epochs)


@dataclass(frozen=True)
class Job:
    """Asks for one network: the domains to learn from and those to stop on."""

    train: Sequence[Trajectories]
    valid: Sequence[Trajectories]
    seed: int
    log: Log = field(default_factory=Log)


class Member:
    """Holds what one network of a stack learns from, and how far it is."""

    def __init__(self, how: Regression, job: Job, horizon: int, device: str, total: int) -> None:
        self.windows, self.scaling = standardise(
            job.train,
            horizon=horizon,
            bodies=how.bodies,
            target=how.target,
            frame=how.frame,
            normalise=how.normalise,
            device=device,
        )
        self.rows = self.windows.inputs.flatten(0, 1), self.windows.targets.flatten(0, 1)
        self.unseen = self.scaling.windows(job.valid, device) if job.valid else None
        self.weighted = False  # whether its weights are in place for good
        self.generator = torch.Generator().manual_seed(job.seed)
        sizes = [self.windows.inputs.shape[-1], *[how.width] * how.depth, COORDINATES]
        self.layers = initial(sizes, self.generator, device)
        self.course = Course(how.plan_of(len(self.windows)), total, job.log)

    def draw(self, steps: int, batch: int) -> list[tuple[Tensor, Tensor]]:
        """Returns the windows of the next steps, each (batch,), and their domains, each (batch,)."""
        index = torch.randint(len(self.windows), (steps, batch), generator=self.generator)
        index = index.to(self.windows.inputs.device)
        domain = self.windows.domain[index // self.windows.inputs.shape[1]]
        return list(zip(index, domain, strict=True))

    def fill(self, index: Tensor, domain: Tensor, inputs: Tensor, targets: Tensor, weight: Tensor) -> None:
        """Copies a batch of windows (batch,) of these domains (batch,) into its place in a stack."""
        torch.index_select(self.rows[0], 0, index, out=inputs)
        torch.index_select(self.rows[1], 0, index, out=targets)
        if not self.weighted:
            torch.index_select(self.windows.weight, 0, domain, out=weight)
            self.weighted = len(self.windows.weight) == 1  # that of the only domain stays where it is

    def report(self, step: int, loss: float, layers: Layers, *, last: bool) -> bool:
        """Reports and validates as `Course` does; returns whether to stop, with the best layers kept."""
        unseen = self.unseen
        check = None if unseen is None else lambda: mean_loss(layers, unseen)
        over = self.course.report(step, loss, flat(layers), check, last)
        if over:
            self.course.restore(flat(layers))
            self.layers = detached(layers)
        return over


def mean_loss(layers: Layers, of: Windows) -> float:
    """Returns the loss of a network, the mean over all of these windows."""
    chunks = [of.pick(slice(i, i + CHUNK)) for i in range(0, len(of), CHUNK)]
    return sum(float(weighted_mse(mlp(layers, x), y, w)) * len(x) for x, y, w in chunks) / len(of)


def regress(
    how: Regression,
    train: Sequence[Trajectories],
    valid: Sequence[Trajectories],
    *,
    horizon: int,
    seed: int,
    device: str,
    budget: Budget,
    log: Log,
) -> Network:
    """Fits one network to the windows of all training domains, pooled, and stops on the validation domains.

    Raises `RunError` when there is nothing to learn from, on values that are not finite, or when the fit diverges.
    """
    [made] = regress_many(how, [Job(train, valid, seed, log)], horizon=horizon, device=device, budget=budget)
    if isinstance(made, RunError):
        raise made
    return made


@torch.no_grad()
def regress_many(
    how: Regression, jobs: Sequence[Job], *, horizon: int, device: str, budget: Budget
) -> list[Network | RunError]:
    """Fits a network to each job, all at once, each as if it were alone; returns them, or why there is none.

    `budget` is that of one fit; M fits may take M times its minutes together. All windows are held in memory at once.
    """
    total, batch = budget.steps_of(how.plan.steps), how.batch
    minutes = None if budget.minutes is None else budget.minutes * len(jobs)
    made, members = dict[int, Network | RunError](), dict[int, Member]()
    for number, job in enumerate(jobs):
        try:
            members[number] = Member(how, job, horizon, device, total)
        except RunError as error:
            made[number] = error
    if not members:
        return [made[number] for number in range(len(jobs))]
    stack = Stack([member.layers for member in members.values()], batch, how.plan.learning_rate)
    since = torch.zeros(len(members), device=device)
    share, step = replace(budget, minutes=minutes).progress(total), 0
    while members:
        if step % REPORT == 0:
            draws = {number: member.draw(REPORT, batch) for number, member in members.items()}
        for slot, (number, member) in enumerate(members.items()):
            member.fill(*draws[number][step % REPORT], *stack.slots[slot])
        since += stack.step()
        step += 1
        last, over = share(step) >= 1, list[int]()
        for slot, (number, member) in enumerate(members.items()):
            if member.course.due(step, last=last):
                try:
                    if member.report(step, float(since[slot]), stack.network(slot), last=last):
                        made[number] = Network(member.layers, member.scaling)
                except RunError as error:
                    made[number] = error
                since[slot] = 0
                over += [slot] if number in made else []
        if over and len(over) < len(members):
            left = [slot for slot in range(len(members)) if slot not in over]
            stack.keep(left)
            since = since[left]
        members = {number: member for number, member in members.items() if number not in made}
    return [made[number] for number in range(len(jobs))]
