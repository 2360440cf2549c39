"""Reads a set and fits a linear model of what four pushes move. Before: `dlobench generate meta-learning`."""

import numpy as np

import dlobench

domains, trajectories = dlobench.load("meta-learning", scale="mini", part="train")
print(domains[["material", "attachment", "length_m", "bending_stiffness_N_m2", "trajectories"]])

soft = domains.query("material == 'soft' and attachment == 'none'").index[0]
print(f"domain {soft}:", trajectories[soft].dlo.shape, "x m, y m, yaw rad of the segments, memory-mapped")

batches = trajectories.minibatches(horizon=4)
squares, products, moved_squares = np.eye(75) * 1e-6, np.zeros((75, 64)), 0.0  # a touch of ridge
for batch in batches.epoch(64, np.random.default_rng(0)):
    rows = [batch.pusher, batch.dlo[..., :2].reshape(-1, 64), batch.actions.reshape(-1, 8), np.ones((len(batch), 1))]
    inputs = np.concatenate(rows, axis=1, dtype=np.float64)
    moved = (batch.dlo_after - batch.dlo)[..., :2].reshape(-1, 64)
    squares, products = squares + inputs.T @ inputs, products + inputs.T @ moved
    moved_squares += float(np.square(moved, dtype=np.float64).sum())
weights = np.linalg.solve(squares, products)
explained = 2 * np.sum(weights * products) - np.sum(weights * (squares @ weights))
print(f"{len(batches):,} windows; a linear model explains {explained / moved_squares:.1%} of what moves")
