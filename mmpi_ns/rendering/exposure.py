"""Exposures of the training images in a model: what images are shown at, and what a test image was taken at."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.data.priors import Gains


class Exposures(torch.nn.Module):
    """Colours of each training image over those of the field; empty where all have the same exposure.

    Args:
        gains: of the training images, if they differ.
    """

    factors: Float[Tensor, "N 3"]
    falloff: Float[Tensor, "2 3"]

    def __init__(self, gains: Gains | None) -> None:
        super().__init__()
        factors, falloff = (np.zeros((0, 3)), np.zeros((2, 3))) if gains is None else (gains.from_field, gains.falloff)
        self.register_buffer("factors", torch.from_numpy(factors).float())
        self.register_buffer("falloff", torch.from_numpy(falloff).float())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes the number of images from the checkpoint; what a dictionary lacks stays, as where nerfstudio loads the
        rest of a pipeline after its model."""
        state_dict.setdefault(f"{prefix}falloff", self.falloff)
        stored = state_dict.setdefault(f"{prefix}factors", self.factors)
        self.factors = torch.empty_like(stored, device=self.factors.device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    @property
    def mean(self) -> Float[Tensor, "3"] | None:
        """Mean exposure of the training images; None where all have the field's."""
        return self.factors.log().mean(0).exp() if len(self.factors) else None
