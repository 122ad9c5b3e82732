"""Colours of samples by a network of each head (paper, MLP^(rgb)): what ``shading sample`` renders and trains."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts, structs
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.gather import interpolated
from mmpi_ns.ops.layout import Places, SceneLayout, check_shapes
from mmpi_ns.scene.geometry import rotate


class Layers(NamedTuple):
    """Weights and biases of a network."""

    w1: Float[Tensor, "W I"]
    b1: Float[Tensor, "W"]
    w2: Float[Tensor, "W W"]
    b2: Float[Tensor, "W"]
    w3: Float[Tensor, "3 W"]
    b3: Float[Tensor, "3"]


class SampleNetworks(NamedTuple):
    """The networks of all heads."""

    layers: tuple[Layers, ...]
    position_frequencies: int
    """Octaves of the positional encoding of NDC positions."""
    direction_frequencies: int
    """Octaves of that of directions, in the head's axes."""


def positional_encoding(x: Float[Tensor, "N 3"], frequencies: int) -> Float[Tensor, "N E"]:
    """(x, sin 2^i pi x, cos 2^i pi x) for i < frequencies (NeRF eq. 4)."""
    octaves = math.pi * 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)
    angles = (x[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([x, angles.sin(), angles.cos()], -1)


def run_layers(layers: Layers, inputs: Float[Tensor, "N I"]) -> Float[Tensor, "N 3"]:
    """What a network makes of its inputs."""
    w1, b1, w2, b2, w3, b3 = layers
    hidden = torch.nn.functional.linear(inputs, w1, b1).relu_()
    hidden = torch.nn.functional.linear(hidden, w2, b2).relu_()
    return torch.nn.functional.linear(hidden, w3, b3)


def head_colors(
    networks: SampleNetworks,
    head: int,
    features: Float[Tensor, "N C"],
    ndc: Float[Tensor, "N 3"],
    directions: Float[Tensor, "R 3"],
    rays: Int[Tensor, "N"],
) -> Float[Tensor, "N 3"]:
    """Colours in [0, 1] of samples of one head: the first three features are their logits, to which the network adds
    what the view changes.

    Args:
        networks: of all heads.
        head: of the samples.
        features: of each sample.
        ndc: position of each sample.
        directions: of each ray, in the head's axes; encoded once a ray.
        rays: ray of each sample.
    """
    position = positional_encoding(ndc, networks.position_frequencies)
    direction = positional_encoding(directions, networks.direction_frequencies).index_select(0, rays)
    said = run_layers(networks.layers[head], torch.cat([features, position, direction], -1))
    return torch.sigmoid(features[:, :3] + said)


def _check_networks(
    layout: SceneLayout, table: Tensor, networks: SampleNetworks, axes: Tensor, directions: Tensor, places: Places
) -> None:
    inputs = table.shape[1] + sum(3 * (1 + 2 * octaves) for octaves in networks[1:])
    for layers in networks.layers:
        check_shapes(Layers, layers._asdict(), {"I": inputs})
    if len(networks.layers) != layout.num_heads:
        raise ValueError(f"networks of {len(networks.layers)} heads where the scene has {layout.num_heads}")


@operation(check=_check_networks)
def shade(
    layout: SceneLayout,
    table: Float[Tensor, "T C"],
    networks: SampleNetworks,
    axes: Float[Tensor, "H 3 3"],
    directions: Float[Tensor, "R 3"],
    places: Places,
) -> Float[Tensor, "R S 3"]:
    """Colours of the valid samples; empty slots are black.

    Args:
        layout: of the scene.
        table: colour features of all texels.
        networks: of all heads.
        axes: of each head, as rows.
        directions: of each ray, world axes.
        places: of the samples.
    """
    _, _, ndc, valid = places
    colors = table.new_zeros(valid.numel(), 3)
    for k, (slots, features) in enumerate(interpolated(layout, table, places)):
        places_of_head = (ndc.reshape(-1, 3)[slots], rotate(axes[k], directions), slots // valid.shape[1])
        colors[slots] = head_colors(networks, k, features, *places_of_head)
    return colors.view(*valid.shape, 3)


@shade.on_cpu
def shade_on_cpu(
    layout: SceneLayout, table: Tensor, networks: SampleNetworks, axes: Tensor, directions: Tensor, places: Places
) -> Tensor:
    pairs = [(w.contiguous(), b.contiguous()) for x in networks.layers for w, b in zip(x[::2], x[1::2], strict=True)]
    tensors, colors = [x.contiguous() for x in (axes, table, directions, *places)], torch.empty(*places.valid.shape, 3)
    shading = structs((*tensors, *table.shape, colors.shape[1], *networks[1:]))
    layers = structs(*((*w.shape, w, b) for w, b in pairs))
    call_in_parts("mmpi_shade", len(colors), layout.cpu_grids, len(layout.mpis), len(axes), shading, layers, colors)
    return colors
