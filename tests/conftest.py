"""Keeps the tests to one thread of torch: small networks gain nothing from more, and machines are shared."""

import torch

torch.set_num_threads(1)
