"""Defines two models."""

from dataclasses import dataclass

from dlobench.bench.model import Model


@dataclass
class One(Model):
    pass


@dataclass
class Two(Model):
    pass
