"""Images of many rays: mixed from the windows that each ray starts in, and rendered in chunks that suit the device."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.scene.windows import Window, window_shares

CPU_RAYS = 4096
"""Rays of a chunk whose samples fit the caches of a CPU and stay below the size that the C library returns to the
system after each use."""
FUSED_RAYS = 4 * CPU_RAYS
"""Rays of a chunk on a CPU if images are rendered in one pass without arrays of samples (``ops.march``)."""
GPU_RAYS = 1 << 20
"""Most rays of a chunk on a GPU: a frame of 1242 x 375, or half of one of 1920 x 1080."""
BYTES_PER_SAMPLE = 128
"""Peak bytes per plane that a ray may intersect: hits, kept samples, colours."""
BYTES_PER_SLOT = 40
"""Bytes of one compiled pass per sample that a ray may keep."""
SQUARE = 4
"""Sides of the squares of pixels that are rendered together: they read the same texels."""
FREE_SHARE = 0.5
"""Fraction of the device's free memory; the rest is left to other programs."""


def render_windows(
    origins: Float[Tensor, "R 3"],
    windows: tuple[Window, ...],
    render: Callable[[int, Int[Tensor, "P"]], dict[str, Tensor]],
    only: int | None = None,
    in_memory: Collection[int] = (),
) -> dict[str, Tensor]:
    """Outputs of rays from all windows that they start in: colours by shares, depth and winner of the largest share.

    Args:
        origins: of the rays.
        windows: the trained ones.
        render: outputs [P, C] of one window, given its index and the numbers of its rays. Called once for each window,
            so that a window is read from disk once at most, however many rays there are.
        only: index of the only window to render; None: the windows that the rays start in.
        in_memory: windows to render first, before the reading of another one evicts them.
    """
    shares = window_shares(origins, windows)
    if only is not None:
        shares = torch.zeros_like(shares).index_fill_(1, torch.tensor([only], device=shares.device), 1.0)
    parts = {}
    for w in sorted((shares > 0).any(0).nonzero()[:, 0].tolist(), key=lambda w: w not in in_memory):
        rays = (shares[:, w] > 0).nonzero()[:, 0]
        parts[w] = rays, render(w, rays)
    mixed: dict[str, Tensor] = {}
    largest = shares.argmax(-1)
    for w, (rays, outputs) in sorted(parts.items()):  # sums do not depend on the order of rendering
        wins = (largest[rays] == w)[:, None]
        for name, values in outputs.items():
            image = mixed.setdefault(name, values.new_zeros(len(shares), *values.shape[1:]))
            image[rays] += values * (wins if name in ("depth", "winning_mpi") else shares[rays, w][:, None])
    return mixed


def rays_per_chunk(samples_per_ray: int, device: torch.device, kept_in_one_pass: int | None = None) -> int:
    """Rays of a chunk if none is configured.

    Args:
        samples_per_ray: maximum samples of a ray: the planes of all MPIs and the steps through the cube.
        device: where they are rendered.
        kept_in_one_pass: samples that a ray can keep, if images are rendered in one compiled pass (``ops.march``),
            which stores no other samples; None if they are rendered step by step.

    Returns:
        A power of two; on a GPU from ``CPU_RAYS`` to ``GPU_RAYS``.
    """
    if device.type != "cuda":
        return CPU_RAYS if kept_in_one_pass is None else FUSED_RAYS
    free = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    held = BYTES_PER_SAMPLE * samples_per_ray if kept_in_one_pass is None else BYTES_PER_SLOT * kept_in_one_pass
    fit = int(FREE_SHARE * free / max(held, 1))
    return min(max(1 << max(fit, 1).bit_length() - 1, CPU_RAYS), GPU_RAYS)


def render_in_chunks(
    bundle: RayBundle, size: int, device: torch.device, render: Callable[[RayBundle], dict[str, Tensor]]
) -> dict[str, Tensor]:
    """Outputs [*N, C] of rays [*N] on the rays' device, rendered on ``device`` in chunks of ``size`` rays.

    nerfstudio's own loop reads the size from the config, which threads share. ``render`` gives [R, C] of R rays.
    """
    parts: dict[str, list[Tensor]] = defaultdict(list)
    rays = bundle.flatten()
    for start in range(0, len(rays), size):
        for name, values in render(rays[start : start + size].to(device)).items():
            parts[name].append(values.to(bundle.origins.device))
    return {name: torch.cat(values).view(*bundle.shape, -1) for name, values in parts.items()}


def square_by_square(height: int, width: int, device: torch.device) -> Int[Tensor, "R"]:
    """Numbers of an image's pixels (row by row), in the order of squares of ``SQUARE`` pixels."""
    y, x = torch.arange(height, device=device) // SQUARE, torch.arange(width, device=device) // SQUARE
    return (y[:, None] * width + x).flatten().sort(stable=True).indices
