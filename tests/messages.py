"""Passes messages by torch_geometric, as the graph network's peer does; to be imported where that is installed.

No annotation here is postponed: torch_geometric writes code by them, and by the calls of `propagate`.
"""

import torch
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing


class Neighbours(MessagePassing):  # type: ignore[misc]
    """Adds up what neighbours are."""

    def __init__(self) -> None:
        super().__init__(aggr="sum")

    def forward(self, edges: Tensor, x: Tensor) -> Tensor:
        """Returns the sums (N, C) along edges (2, E) of nodes (N, C)."""
        out: Tensor = self.propagate(edges, x=x)
        return out

    def message(self, x_j: Tensor) -> Tensor:
        """Returns the messages (E, C) of neighbours (E, C)."""
        return x_j


class Told(MessagePassing):  # type: ignore[misc]
    """Adds up what bodies are, times a weight an edge."""

    def __init__(self) -> None:
        super().__init__(aggr="sum")

    def forward(self, edges: Tensor, x: tuple[Tensor, Tensor], weight: Tensor) -> Tensor:
        """Returns the sums (N, C) along edges (2, E) from bodies to segments, the pair in `x`."""
        out: Tensor = self.propagate(edges, x=x, weight=weight, size=(x[0].shape[0], x[1].shape[0]))
        return out

    def message(self, x_j: Tensor, weight: Tensor) -> Tensor:
        """Returns the messages (E, C) of neighbours (E, C)."""
        return weight * x_j


class Touches(MessagePassing):  # type: ignore[misc]
    """Adds up what a layer makes of segments and edges, times a weight an edge."""

    def __init__(self, layer: nn.Module) -> None:
        super().__init__(aggr="sum")
        self.layer = layer

    def forward(self, edges: Tensor, x: tuple[Tensor, Tensor], edge: Tensor, weight: Tensor) -> Tensor:
        """Returns the sums (M, C) along edges (2, E) from segments to bodies, the pair in `x`."""
        out: Tensor = self.propagate(edges, x=x, edge=edge, weight=weight, size=(x[0].shape[0], x[1].shape[0]))
        return out

    def message(self, x_j: Tensor, edge: Tensor, weight: Tensor) -> Tensor:
        """Returns the messages (E, C) of neighbours (E, C) along edges (E, 6)."""
        return weight * torch.relu(self.layer(torch.cat([x_j, edge], -1)))
