"""Scores models on tasks: the plugins' contract, the evaluator, records, the leaderboard."""
