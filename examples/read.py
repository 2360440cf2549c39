"""Reads a set: fits a linear model to its windows. Before: `dlobench generate meta-learning`."""

import numpy as np
import torch

import dlobench

domains, trajectories = dlobench.load("meta-learning", scale="mini", part="train")
print(domains[["material", "attachment", "length_m", "bending_stiffness_N_m2", "trajectories"]])

soft = domains.query("material == 'soft' and attachment == 'none'").index[0]
print(f"domain {soft}:", trajectories[soft].dlo.shape, "x m, y m, yaw rad of the segments, memory-mapped")

batches = trajectories.minibatches(horizon=4)
model = torch.nn.Linear(2 + 64 + 8, 64)
optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
for arrays in batches.epoch(64, np.random.default_rng(0)):
    batch = arrays.torch()
    inputs = torch.cat([batch.pusher, batch.dlo[..., :2].flatten(1), batch.actions.flatten(1)], dim=1)
    moved = (batch.dlo_after - batch.dlo)[..., :2].flatten(1)
    loss = (model(inputs) - moved).square().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
print(f"{len(batches):,} windows; the last minibatch is wrong by {1000 * float(loss) ** 0.5:.1f} mm a coordinate")
