"""Simulates the world: scenes from domains, starts, actions, the batched simulator and the environment."""

VERSION = 2  # raised whenever the same seed would give other trajectories; part of every set's digest
