"""Which samples of a ray train, and nerfstudio's rays as the march takes them (paper sec. III-B)."""

from __future__ import annotations

from dataclasses import dataclass

from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.ops.march import MarchOptions, Rays
from mmpi_ns.scene.plan import ScenePlan

FAIR_SHARE = 0.1
"""While surfaces are forming, samples with more than this fraction of an equal weight are kept."""


@dataclass
class SamplingConfig:
    """Samples of a ray: ``--pipeline.model.sampling.*``."""

    threshold: float = 3e-3
    """Samples of less weight get no gradient (at most a tenth of an equal share while the resolution grows)."""
    samples_per_voxel: float = 1.0
    """Samples per voxel side along a ray through the cube."""
    cube_alpha: float = 1e-3
    """Initial alpha of a cube sample: 1e-2 for a small room to 1e-4."""

    def options(self, plan: ScenePlan, forming: bool, blends: bool) -> MarchOptions:
        """Which samples are kept in training (``ops.march.prune``).

        While surfaces are forming, samples of little weight must learn too, and the cube starts nearly empty.
        """
        cube = 0.1 * self.cube_alpha if forming and plan.cube is not None else float("inf")
        return MarchOptions(min(self.threshold, cube), FAIR_SHARE if forming else float("inf"), blends)


def rays_of(ray_bundle: RayBundle, head_mask: Tensor | None = None, choose: Tensor | None = None) -> Rays:
    """Rays for the march, and the heads that may render them (see ``ops.march.Rays``)."""
    nears, fars = ray_bundle.nears, ray_bundle.fars
    assert nears is not None and fars is not None
    return Rays(ray_bundle.origins, ray_bundle.directions, nears, fars, head_mask, choose)
