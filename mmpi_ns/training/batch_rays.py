"""Rays of a training batch: moved with the poses that are refined, and assigned to MPIs in the individual phase."""

from __future__ import annotations

from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.capture.ray_sources import OWN_PIXEL
from mmpi_ns.scene.plan import ScenePlan


@torch.no_grad()
def keep_frame(
    moves: Float[Tensor, "M 6"], centers: Float[Tensor, "M 3"], distance: float, scale_is_free: bool
) -> None:
    """Removes from pose corrections, in place, the motion of the whole capture that no training image shows (gauge).

    The scene would follow a rigid motion of all cameras, but test images keep their poses. Cameras that each turn by
    the same angle where they stand are no rigid motion: images show that, and it stays. The motion is fitted by least
    squares; what it leaves of the corrections shows the same images, to second order in the corrections.

    Args:
        moves: shift in scene units and rotation vector of each camera, about the world's axes (nerfstudio's SO3xR3).
        centers: the cameras' positions before the corrections.
        distance: of the content, by which a turn weighs as much as the shift of what is seen. Scene units.
        scale_is_free: no depth measurement fixes the scale of the capture, so a change of scale is removed as well.
    """
    shifts, turns = moves.double().split(3, -1)
    places = centers.to(shifts) + shifts
    places = places - places.mean(0)
    eye = torch.eye(3).to(places).expand(len(places), 3, 3)
    shift = torch.cat([eye, torch.linalg.cross(eye, places[:, None].expand(-1, 3, 3)), places[:, None]], 1)
    turn = torch.cat([torch.zeros_like(eye), eye, torch.zeros_like(places)[:, None]], 1)
    free = 7 if scale_is_free else 6
    motions = torch.cat([shift, turn], -1)[:, :free]  # of each camera, by each free motion
    weight = motions.new_tensor([1.0] * 3 + [max(distance, 1e-6)] * 3)
    system = (motions * weight).transpose(1, 2).reshape(-1, free)
    share = torch.linalg.pinv(system.mT @ system, hermitian=True) @ (system.mT @ (moves * weight).flatten())
    shift, turn = torch.einsum("k,mkc->mc", share, motions).split(3, -1)
    # exp(-turn) exp(turns), by Baker, Campbell and Hausdorff.
    moves -= torch.cat([shift, turn + torch.linalg.cross(turn, turns) / 2], -1).to(moves)


def move_rays(bundle: RayBundle, poses: CameraOptimizer) -> None:
    """Moves a training batch's rays with their cameras, in place.

    Rays of new views and keypoint rays follow their camera but do not move it: their depths come from the original
    poses and would pull the camera back to them.
    """
    if poses.config.mode == "off":
        return
    poses.apply_to_raybundle(bundle)
    moves_camera = bundle.metadata[OWN_PIXEL]
    bundle.origins = torch.where(moves_camera, bundle.origins, bundle.origins.detach())
    bundle.directions = torch.where(moves_camera, bundle.directions, bundle.directions.detach())


def individual_rays(
    bundle: RayBundle, plan: ScenePlan, rays_per_mpi: Literal["split", "all"], g: torch.Generator
) -> tuple[RayBundle, Bool[Tensor, "R H"] | None, Float[Tensor, "R K"] | None]:
    """Rays of the individual phase, each for one of the MPIs it meets or for every MPI in turn, and for the cube (paper
    sec. III-C, first stage).

    Returns:
        The rays, (all) the heads that each may meet, and (split) priorities of the MPIs.
    """
    num_mpis, device = len(plan.mpis), bundle.origins.device
    if num_mpis == 1:
        return bundle, None, None
    if rays_per_mpi == "split":
        return bundle, None, torch.rand(len(bundle), num_mpis, generator=g, device=device)
    heads = torch.arange(num_mpis, device=device).repeat_interleave(len(bundle))
    mask = torch.arange(plan.num_heads, device=device) == heads[:, None]
    mask[:, num_mpis:].fill_(True)

    def repeat(x: Tensor | None) -> Any:
        return None if x is None else x.repeat(num_mpis, *([1] * (x.ndim - 1)))

    names = ("origins", "directions", "pixel_area", "camera_indices", "nears", "fars")
    metadata = {name: repeat(values) for name, values in bundle.metadata.items()}
    return RayBundle(**{name: repeat(getattr(bundle, name)) for name in names}, metadata=metadata), mask, None
