"""Rays through baked multi-plane images, compiled (``baked.cpp``)."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.baked.reference import Gathered
from mmpi_ns.ops.build import arguments, call_in_parts
from mmpi_ns.ops.cpu_scene import Layer
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.scene.baked import MOST_CHANNELS, BakedMpis, Shader, tiles_of


class _Head(ctypes.Structure):
    _fields_ = [
        ("origin", ctypes.c_float * 3),
        ("axes", ctypes.c_float * 9),
        *((n, ctypes.c_float) for n in ("u0", "v0", "u1", "v1", "u_scale", "v_scale", "step", "end")),
        *((n, ctypes.c_int32) for n in ("planes", "height", "width", "down", "across", "first_column")),
        ("pass_", ctypes.c_void_p),
    ]


class _Scene(ctypes.Structure):
    _fields_ = [
        *((n, ctypes.c_int64) for n in ("num_heads", "channels")),
        *((n, ctypes.c_void_p) for n in ("heads", "columns", "density", "texels", "low", "step")),
    ]


class _Packed:
    """A scene as the kernel reads it, with all that it points to."""

    def __init__(self, scene: BakedMpis) -> None:
        channels = scene.texels.shape[-1]
        assert channels <= MOST_CHANNELS
        self.passes = [scene.steps_of_depth(k) for k in range(len(scene.mpis))]
        heads = []
        for k, mpi in enumerate(scene.mpis):
            u0, u1, v0, v1 = mpi.extent
            _, down, across = tiles_of(mpi)
            axes = (ctypes.c_float * 9)(*(x for row in mpi.axes for x in row))
            scales = ((mpi.width - 1) / (u1 - u0), (mpi.height - 1) / (v1 - v0))
            sizes = (mpi.planes, mpi.height, mpi.width, down, across, scene.first_column(k))
            place = (ctypes.c_float * 3)(*mpi.origin), axes, u0, v0, u1, v1, *scales
            heads.append(_Head(*place, mpi.disparity_step, mpi.last_disparity, *sizes, self.passes[k].data_ptr()))
        self.heads = (_Head * len(heads))(*heads)
        # Sixteen channels are read at once, also those of the last texel, and four densities.
        self.density, self.texels = (pad(x.reshape(-1), (0, MOST_CHANNELS)) for x in (scene.density, scene.texels))
        low, step = (torch.tensor([getattr(c, name) for c in scene.channel_codes]) for name in ("low", "step"))
        doubled = torch.tensor([1.0] * COLORS + [2.0] * (channels - COLORS))  # tanh x = 2 sigmoid(2 x) - 1
        self.codes = [pad(doubled * x, (0, MOST_CHANNELS - channels)) for x in (low, step)]
        tables = arguments([scene.columns, self.density, self.texels, *self.codes])
        self.scene = _Scene(len(heads), channels, ctypes.addressof(self.heads), *tables)


def march_baked(
    scene: BakedMpis,
    origins: Tensor,
    directions: Tensor,
    nears: Tensor,
    fars: Tensor,
    threshold: float,
    peaks: Any = None,
) -> Gathered:
    """See ``ops.baked``."""
    num_rays = len(origins)
    sums, winner = torch.empty(num_rays, scene.texels.shape[-1]), torch.empty(num_rays, 1, dtype=torch.int64)
    mass, passing, inverse_t = (torch.empty(num_rays, 1) for _ in range(3))
    before = (_packed(scene), *(x.contiguous() for x in (origins, directions, nears, fars)), float(threshold))
    # Where peaks are wanted, one thread alone: all would write to the same ones.
    least = 256 if peaks is None else max(num_rays, 1)
    after = (sums, mass, passing, inverse_t, winner, peaks)
    call_in_parts("mmpi_march_baked", num_rays, before, after, least)
    return Gathered(sums, mass, passing, inverse_t, winner)


def _packed(scene: BakedMpis) -> Any:
    """A scene as the kernels take it, made once."""
    if "cpu" not in scene.packed:
        scene.packed["cpu"] = _Packed(scene)
    return ctypes.byref(scene.packed["cpu"].scene)


def shade_baked(shader: Shader, sums: Tensor, mass: Tensor, directions: Tensor) -> Tensor:
    """See ``ops.baked``."""
    numbers = [(w.contiguous(), b.contiguous()) for w, b in shader.layers]  # alive until the kernel has run
    given, rgb = [x.contiguous() for x in (sums, mass, directions)], torch.empty(len(sums), 3)
    sizes = (len(numbers), sums.shape[-1], shader.direction_octaves, float(shader.bound))
    call_in_parts("mmpi_shade_baked", len(sums), (Layer.array(numbers), *sizes, *given), (rgb,))
    return rgb
