"""Predicts an unseen domain by attending to windows of its support that are like the one it is asked about."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from dlobench.bench.model import Model, Setting
from dlobench.errors import UsageError
from dlobench.nn.episodes import Batch, draw
from dlobench.nn.fit import CHUNK, Plan, descend, positive
from dlobench.nn.networks import weighted_mse
from dlobench.nn.windows import COORDINATES, Scaling, Target, standardise
from dlobench.trajectories import Prediction, Query, Trajectories

Known = tuple[Tensor, Tensor]  # keys and values of a support: (N, 1 + P, W) each, the first of them nobody's


class AttentiveProcess(nn.Module):
    """Predicts targets of windows from those of a support: a deterministic attentive neural process.

    What a support says is a key and a value for each of its windows, and one of each that is always there, to which
    all attend when there is no support.
    """

    def __init__(self, inputs: int, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.look = nn.Sequential(nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, width))
        self.say = nn.Sequential(
            nn.Linear(inputs + COORDINATES, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, width),
        )
        self.nobody = nn.Parameter(torch.zeros(2, width))
        self.tell = nn.Sequential(
            nn.Linear(inputs + 2 * width, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, width), nn.SiLU(), nn.Linear(width, COORDINATES),
        )  # fmt: skip

    def support(self, inputs: Tensor, targets: Tensor) -> Known:
        """Returns what the windows (N, P, F) of N supports say; P may be 0."""
        key, value = (each.expand(len(inputs), 1, -1) for each in self.nobody)
        said = self.say(torch.cat([inputs, targets], -1))
        return torch.cat([key, self.look(inputs)], 1), torch.cat([value, said], 1)

    def forward(self, inputs: Tensor, known: Known) -> Tensor:
        """Returns targets (N, B, 64) of windows (N, B, F)."""

        def headed(rows: Tensor) -> Tensor:
            return rows.view(*rows.shape[:2], self.heads, rows.shape[-1] // self.heads).transpose(1, 2)

        found = scaled_dot_product_attention(headed(self.look(inputs)), headed(known[0]), headed(known[1]))
        whole = known[1].mean(1, keepdim=True).expand(-1, inputs.shape[1], -1)
        told: Tensor = self.tell(torch.cat([inputs, found.transpose(1, 2).flatten(2), whole], -1))
        return told


@dataclass
class NeuralProcess(Model):
    """Learns to predict windows of a domain from those of its support, without a gradient when it adapts.

    Follows Kim et al. (2019), attentive neural processes, of the deterministic path alone and trained on the squared
    error: keys are embeddings of windows, values of windows with what came of them, and the mean of all values says
    what the domain is like. Each step draws N domains and one K of those it will be asked about or 0; of a support,
    `points` windows are looked at while learning, all of them later. Not in the paper; it sees what `maml` sees.
    Shapes: support (P, 66 + 2 n) and (P, 64), then (B, 66 + 2 n) to (B, 64). Cost: 161,000 parameters at n = 4; on one
    core about 17 ms a step.
    """

    N: int = 16  # tasks a step
    queries: int = 4  # query trajectories of a task while learning, at most
    points: int = 128  # support windows of a task while learning, at most
    width: int = 128
    heads: int = 4
    learning_rate: float = 1e-3
    steps: int = 6000
    target: Target = "displacement"

    network: AttentiveProcess = field(init=False, repr=False, compare=False)
    scaling: Scaling = field(init=False, repr=False, compare=False)
    known: Known = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        positive(self, "N", "queries", "points", "width", "heads", "steps", "learning_rate")
        if self.width % self.heads:
            raise UsageError(f"width = {self.width} is no multiple of heads = {self.heads}, which share it")

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns from tasks of all training domains; keeps the weights that are best on those of validation domains."""
        windows, self.scaling = standardise(
            train, horizon=setting.horizon, bodies=False, target=self.target, device=self.device
        )
        unseen = self.scaling.windows(valid, self.device) if valid else None
        generator = torch.Generator().manual_seed(self.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            self.network = AttentiveProcess(windows.inputs.shape[-1], self.width, self.heads).to(self.device)
        supports = [K for K in setting.K if K > 0] or [1]

        def loss(support: Batch, query: Batch, points: int) -> Tensor:
            known = self.network.support(support[0][:, :points], support[1][:, :points])
            return weighted_mse(self.network(query[0], known), query[1], query[2]).mean()

        def train_loss() -> Tensor:
            K = (0, *supports)[int(torch.randint(len(supports) + 1, (), generator=generator))]
            domains = torch.randint(len(windows.count), (self.N,), generator=generator)
            support, query = draw(windows, domains, max(1, K), queries=self.queries, generator=generator)
            order = torch.randperm(support[0].shape[1], generator=generator).to(self.device)
            mixed = support[0][:, order], support[1][:, order], support[2]
            return loss(mixed, query, min(self.points, len(order)) if K else 0)

        again = torch.arange(len(valid)).repeat(2)
        fixed = [draw(unseen, again, K, queries=10, generator=generator) for K in supports] if unseen else []

        def valid_loss() -> float:
            losses = [loss(*pair, points) for pair in fixed for points in (0, pair[0][0].shape[1])]
            return torch.stack(losses).mean().item()

        plan = Plan(self.steps, self.learning_rate, patience=self.steps, every=250, cosine=True, clip=1.0)
        check = valid_loss if fixed else None
        descend(list(self.network.parameters()), train_loss, check, plan=plan, budget=setting.budget, log=setting.log)
        self.network.requires_grad_(False)
        nothing = torch.zeros(1, 0, windows.inputs.shape[-1], device=self.device)
        self.known = self.network.support(nothing, nothing[..., :1].expand(1, 0, COORDINATES))

    def adapt(self, support: Trajectories) -> NeuralProcess:
        """Returns a copy that knows the windows of the support; itself when there are none."""
        if not len(support):
            return self
        inputs, targets, _ = self.scaling.windows([support], self.device).pick(slice(None))
        model = copy.copy(self)
        model.known = self.network.support(inputs[None], targets[None])
        return model

    @torch.no_grad()
    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2)."""
        chunks = torch.split(self.scaling.inputs(query).to(self.device), CHUNK)
        outputs = torch.cat([self.network(chunk[None], self.known)[0] for chunk in chunks])
        return Prediction(dlo=self.scaling.positions(outputs, query)[None])

    def parameters(self) -> int:
        """Returns the number of weights and biases."""
        return sum(weight.numel() for weight in self.network.parameters())
