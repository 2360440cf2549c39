"""Tests learn2learn's MAML beside ours: the same loss, the same gradients, and a sentence where it is missing."""

from __future__ import annotations

import sys
from typing import Any

import pytest
import torch
from test_maml import maml, problem
from test_nn import load
from toy import toy_domains

from dlobench.bench.model import Setting
from dlobench.errors import RunError, UsageError
from dlobench.nn import networks

theirs = load("maml_learn2learn")


@pytest.mark.parametrize("options", [{}, {"steps": 3}, {"first_order": True}, {"first_order": True, "steps": 2}])
def test_loss_and_gradients_equal_ours(options: dict[str, Any]) -> None:
    pytest.importorskip("learn2learn", reason=theirs.MISSING)
    layers, rates, support, query = problem()
    rate = rates.detach()[:1].requires_grad_()
    learned = [*networks.flat(layers), rate]
    loss = theirs.looped_loss(layers, rate[0], support, query, **options)
    ours = maml.meta_loss(layers, rate, support, query, **options)
    torch.testing.assert_close(loss, ours, rtol=0, atol=1e-9)
    for a, b in zip(torch.autograd.grad(loss, learned), torch.autograd.grad(ours, learned), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)
        assert b.abs().max() > 1e-6


def test_a_fit_equals_ours() -> None:
    pytest.importorskip("learn2learn", reason=theirs.MISSING)
    domains, setting = toy_domains(5, trajectories=8), Setting(horizon=2, K=(1,))
    options: dict[str, Any] = {"width": 8, "depth": 2, "steps": 5, "rate_per": "network"}
    fits = [theirs.MamlLearn2learn(**options), maml.Maml(**options)]
    for model in fits:
        model.fit(domains[:4], domains[4:], setting)
    for a, b in zip(*(networks.flat(model.network.layers) for model in fits), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4)


def test_what_is_missing_is_named_with_the_way_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "learn2learn", None)
    with pytest.raises(RunError, match=r"pip install learn2learn==0\.2\.0"):
        theirs.MamlLearn2learn(steps=1).fit(toy_domains(2, trajectories=3), [], Setting(horizon=2, K=(1,)))


def test_what_learn2learn_cannot_do_is_refused() -> None:
    with pytest.raises(UsageError, match="adapts = 'head'"):
        theirs.MamlLearn2learn(adapts="head").fit([], [], Setting(horizon=2, K=(1,)))
