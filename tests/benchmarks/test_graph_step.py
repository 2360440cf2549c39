"""Measures a step of the graph network beside the same network in torch_geometric: messages over lists of edges.

Two threads, float32, 64 scenes of 32 segments. Both sides look at scenes by the same code, so the ratio is that of a
whole step. Where benchmarks are disabled, the two are held against each other once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from rates import Tables, paired
from torch import Tensor
from toy import toy_scene

from dlobench.nn import graph
from dlobench.nn.geometry import Scene
from dlobench.nn.graph import ROUNDS, GraphNetwork

GRAPH = "a training step of the graph network at batch 64, ms; × how many times as fast as torch_geometric"
pytestmark = pytest.mark.usefixtures("two_threads")


def chain(B: int, N: int) -> dict[int, Tensor]:
    """Returns the edges (2, E) of B chains of N segments, from the segment that is so many before, or after."""
    at = torch.arange(B * N).view(B, N)
    offsets = sorted({sign * by for hears in ROUNDS for by in hears for sign in (1, -1)})
    return {
        by: torch.stack([at[:, :-by].flatten(), at[:, by:].flatten()])
        if by > 0
        else torch.stack([at[:, -by:].flatten(), at[:, :by].flatten()])
        for by in offsets
    }


def peer(network: GraphNetwork, B: int, N: int, M: int) -> Callable[[Scene, Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Returns `GraphNetwork._moves` as torch_geometric has it, with the same weights.

    Nodes are segments and bodies in one row a node, neighbours along the chain are relations (as in its RGCNConv, whose
    masks of edges are taken out of the step, since all batches have the same chains), scenes are pooled.
    """
    import messages
    from torch_geometric.nn import global_mean_pool

    edges, neighbours, tell = chain(B, N), messages.Neighbours(), messages.Told()
    touches = [messages.Touches(layer) for layer in network.touches]
    scene_of, of_body = torch.arange(B).repeat_interleave(N), torch.arange(B).repeat_interleave(M)
    body, segment = torch.meshgrid(torch.arange(M), torch.arange(N), indexing="ij")
    first = torch.arange(B)[:, None, None]
    down = torch.stack([(first * N + segment).flatten(), (first * M + body).flatten()])  # (2, B M N)
    up = down.flip(0)

    def moves(local: Scene, length: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        features = graph.segment_features(local, length).flatten(0, 1)
        h = network.segment(torch.cat([features, known[scene_of]], -1))
        if M:
            b = network.body(torch.cat([graph._bodies(local, length).flatten(0, 1), known[of_body]], -1))
            edge, close = graph._edges(local)
            edge, close = edge.flatten(0, 2), close.reshape(-1, 1)
        for k, hears in enumerate(ROUNDS):
            g = network.norms[k](h)
            whole = global_mean_pool(g, scene_of, size=B)
            heard = [neighbours(edges[s * by], g) for by in hears for s in (1, -1)]
            if M:
                told = tell(up, (b, g), close)
                felt = touches[k](down, (g, b), edge, close)
                b = b + network.bodies[k](torch.cat([b, felt, whole[of_body]], -1))
            else:
                told = torch.zeros_like(g)
            h = h + network.rounds[k](torch.cat([g, *heard, told, whole[scene_of]], -1))
        moved = (network.move(h) * network.scale).view(B, N, 2)
        if not M:
            return moved, local.bodies
        turned = network.turn(b) * network.scale * h.new_tensor([1.0, 1.0, 1.0 / graph.LEVER])
        return moved, turned.view(B, M, 3)

    return moves


@pytest.mark.parametrize("bodies", [0, 3])
def test_a_step_of_the_graph_network(benchmark: BenchmarkFixture, tables: Tables, bodies: int) -> None:
    pytest.importorskip("torch_geometric", reason="torch_geometric is not installed: make peers")
    B = 64 if benchmark.enabled else 4
    network, scene, action = GraphNetwork(32, 0.004), toy_scene(B, bodies), 0.01 * torch.randn(B, 2)
    theirs_moves = peer(network, B, scene.dlo.shape[1], bodies)

    def step(moves: Callable[..., Any]) -> tuple[Tensor, ...]:
        local = graph.local_frame(scene, action, scene.pusher, mirror=False)
        length = action.norm(dim=-1, keepdim=True)
        dlo, turned, *_ = moves(local, length, graph.scene_features(local, length))
        loss = (dlo / network.scale).square().sum() + (turned / network.scale).square().sum()
        return torch.autograd.grad(loss, list(network.parameters()), allow_unused=not bodies)

    for one, other in zip(step(network._moves), step(theirs_moves), strict=True):
        if one is not None or other is not None:
            assert one.abs().max() > 0
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4 * float(one.abs().max()))
    rounds = 40 if benchmark.enabled else 1
    ours, theirs = paired(lambda: step(network._moves), lambda: step(theirs_moves), rounds)
    benchmark.pedantic(lambda: step(network._moves), rounds=1)  # type: ignore[no-untyped-call]
    if benchmark.enabled:
        line = f"{bodies} bodies {1e3 * ours:8.1f}, torch_geometric {1e3 * theirs:8.1f}  × {theirs / ours:.1f}"
        tables.setdefault(GRAPH, []).append(line)
