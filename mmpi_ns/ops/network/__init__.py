"""Networks of two hidden layers for many rows: a third of a training step where every sample has one (C++ here)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import linear

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.layout import dense

OUTPUTS = 3
CHUNKS, LEAST_CHUNK = 16, 96
"""Pieces of the rows whose gradients of weights are summed first, whatever the threads, and their least rows."""


def layer_shapes(inputs: int, width: int) -> list[tuple[int, ...]]:
    """Shapes of the weights and biases of the three layers, in their order."""
    return [(width, inputs), (width,), (width, width), (width,), (OUTPUTS, width), (OUTPUTS,)]


def layers(weights: Float[Tensor, "P"], shapes: Sequence[tuple[int, ...]]) -> list[Tensor]:
    """Weights and biases of layers of these shapes."""
    return [p.view(s) for p, s in zip(weights.split([math.prod(s) for s in shapes]), shapes, strict=True)]


@operation()
def network(weights: Float[Tensor, "P"], inputs: Float[Tensor, "N I"], width: int) -> Float[Tensor, "N 3"]:
    """Outputs of a network with ReLU after each hidden layer, with gradients to weights and inputs.

    Args:
        weights: of all layers (``layers``).
        inputs: rows.
        width: of the hidden layers.
    """
    w1, b1, w2, b2, w3, b3 = layers(weights, layer_shapes(inputs.shape[1], width))
    hidden = linear(inputs, w1, b1).relu_()
    return linear(linear(hidden, w2, b2).relu_(), w3, b3)


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, inputs: Tensor, width: int) -> Tensor:
        outputs = torch.empty(len(inputs), OUTPUTS)
        call_in_parts("mmpi_network", len(inputs), weights, inputs, width, inputs.shape[1], outputs)
        ctx.save_for_backward(weights, inputs)
        ctx.width = width
        return outputs

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        weights, inputs = ctx.saved_tensors
        size = max(LEAST_CHUNK, -(-len(inputs) // CHUNKS))
        chunks = -(-len(inputs) // size)
        grad_inputs, grad_weights = torch.empty_like(inputs), torch.empty(chunks, len(weights))
        given = (weights, inputs, grad_outputs[0].contiguous(), len(inputs), size, ctx.width, inputs.shape[1])
        call_in_parts("mmpi_network_back", chunks, *given, grad_inputs, grad_weights, least=1)
        return grad_weights.sum(0), grad_inputs, None


@network.on_cpu
def network_on_cpu(weights: Tensor, inputs: Tensor, width: int) -> Tensor:
    return _Network.apply(*dense(weights, inputs), width)  # type: ignore[misc]
