"""Losses of rays: their constants and results; ``training/losses.py`` defines them, Triton forms are in ``gpu``."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

CLIPPED = 0.98
"""Colour of an image above which a channel may be clipped."""
LEAST = 1e-6
"""Minimum of a transmittance and of its complement, in their entropy."""
DEPTH_OUTLIERS = 0.02
"""Likelihood of a depth prior where a ray has no weight: the larger, the less influence outliers have."""
KEYPOINT_WIDTH, KEYPOINT_OUTLIERS = 0.06, 1e-4
"""Standard deviation of the window round an SfM keypoint, relative to its inverse distance, and likelihood of a false
one. Its mean is over the keypoint rays that can reach their point."""


class RayLosses(NamedTuple):
    """Losses of a batch, each times its weight; None where no ray has one."""

    rgb_loss: Float[Tensor, ""]
    point_color: Float[Tensor, ""]
    entropy: Float[Tensor, ""]
    distortion: Float[Tensor, ""]
    keypoint_depth: Float[Tensor, ""] | None
    depth_priors: Float[Tensor, ""] | None
    errors: Float[Tensor, "R"]
    """Squared colour error of each ray without gradients, 0 for keypoint rays."""
