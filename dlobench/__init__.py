"""Benchmarks models of deformable-object dynamics: worlds, data, protocols, models, a leaderboard."""

__version__ = "0.1.0"
