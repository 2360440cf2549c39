"""Keeps the data: sets, shards, generation."""
