"""How many rays are rendered at once: as many as suit the caches of a CPU, or as fit into the memory of a GPU."""

from __future__ import annotations

import torch

CPU_RAYS = 4096
"""Their samples stay in the caches' reach and below what the C library gives back to the system after each use."""
GPU_RAYS = 1 << 17
"""Of more, launches are no smaller part of the time."""
BYTES_PER_SAMPLE = 128
"""What rendering holds at its peak for every plane that a ray may cross: where it is hit, what is kept, its colour."""
FREE_SHARE = 0.5
"""Of the device's free memory; the rest is for what else runs there."""


def rays_at_once(samples_per_ray: int, device: torch.device) -> int:
    """Rays to render at once where no number is asked for.

    Args:
        samples_per_ray: samples that a ray has at most: the planes of all MPIs and the steps through the cube.
        device: where they are rendered.

    Returns:
        A power of two from ``CPU_RAYS`` to ``GPU_RAYS``.
    """
    if device.type != "cuda":
        return CPU_RAYS
    free = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    fit = int(FREE_SHARE * free / (BYTES_PER_SAMPLE * max(samples_per_ray, 1)))
    return min(max(1 << max(fit, 1).bit_length() - 1, CPU_RAYS), GPU_RAYS)
