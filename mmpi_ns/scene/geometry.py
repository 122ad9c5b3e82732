"""The MPI frame: world <-> NDC, plane hits and the planes that a ray intersects (docs/how_it_works.md, "Geometry").

Everything here is affine in disparity w = 1/depth, so a plane at infinity (w = 0) is an ordinary plane.
Points are represented as homogeneous pairs ``(o/t + d, 1/t)``, which are finite and exact at infinity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.scene.plan import CubePlan, MPIPlan

FACING_EPS = 1e-6
"""Cosine below which a ray counts as parallel to the planes and intersects none of them."""


@dataclass(frozen=True)
class Frames:
    """K MPI frames as tensors. ``axes`` rows are x (right), y (down), z (facing) in world coordinates."""

    origins: Float[Tensor, "K 3"]
    axes: Float[Tensor, "K 3 3"]
    nears: Float[Tensor, "K"]
    extents: Float[Tensor, "K 4"]
    num_planes: Int[Tensor, "K"]
    last_disparities: Float[Tensor, "K"]
    """Disparity of the last plane, 1 / far; 0 if an MPI reaches to infinity."""
    depth_shares: Float[Tensor, "K"]
    """1 - near / far: the fraction of all disparities beyond the near plane that an MPI spans; 1 to infinity."""
    disparity_steps: Float[Tensor, "K"]
    """Disparity between neighbouring planes, (1/near - 1/far) / (L - 1), in 1 / scene units."""

    @staticmethod
    def pack(mpis: Sequence[MPIPlan], dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Frames:
        shapes = {"origin": (3,), "axes": (3, 3), "near": (), "extent": (4,)}
        origins, axes, nears, extents = (
            torch.tensor([getattr(m, name) for m in mpis], dtype=dtype, device=device).reshape(len(mpis), *shape)
            for name, shape in shapes.items()
        )
        ends = torch.tensor([1 / m.far for m in mpis], dtype=dtype, device=device)
        planes = torch.tensor([m.planes for m in mpis], dtype=torch.int64, device=device)
        shares = 1.0 - nears * ends
        steps = shares / (nears * (planes - 1).to(dtype))
        return Frames(origins, axes, nears, extents, planes, ends, shares, steps)


@dataclass(frozen=True)
class PlaneHits:
    """Intersections of R rays with the planes of K MPIs.

    Planes are counted by m = L - 1 - l, so m = 0 is the last one and the disparity is w = 1/far + m * step. The planes
    that a ray intersects are m_first, m_first - 1, ..., ``count`` of them, near to far.
    """

    m_first: Int[Tensor, "R K"]
    """m of the nearest intersected plane."""
    count: Int[Tensor, "R K"]
    """Number of intersected planes."""
    u: Float[Tensor, "R K 2"]
    """u(w) = u[0] + w u[1], tangent along the frame's x."""
    v: Float[Tensor, "R K 2"]
    """v(w) = v[0] + w v[1], tangent along the frame's y."""
    local_origins: Float[Tensor, "R K 3"]
    local_directions: Float[Tensor, "R K 3"]


def rotate(axes: Float[Tensor, "*#N 3 3"], vectors: Float[Tensor, "*#N 3"]) -> Float[Tensor, "*N 3"]:
    """axes @ vector by elementwise products: a matrix product would run in bfloat16 under autocast."""
    return (axes * vectors[..., None, :]).sum(-1)


def local_rays(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], frames: Frames
) -> tuple[Float[Tensor, "R K 3"], Float[Tensor, "R K 3"]]:
    """Origins and directions of rays in every MPI's axes, relative to the MPI's origin."""
    # Differences first, to keep precision far from the world origin.
    return rotate(frames.axes, origins[:, None, :] - frames.origins), rotate(frames.axes, directions[:, None, :])


def plane_hits(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    nears: Float[Tensor, "R 1"],
    fars: Float[Tensor, "R 1"],
    frames: Frames,
) -> PlaneHits:
    """The planes that each ray intersects in each MPI, in closed form.

    A plane counts if it faces the ray, lies ahead of the camera, between near and far, and is intersected inside the
    MPI's extent. Each condition is a half-space p w <= q in disparity, so these planes are one range.

    Args:
        origins: ray origins, world axes, scene units.
        directions: unit ray directions, world axes.
        nears: distance at which rays start.
        fars: distance at which rays end; may be inf.
        frames: the K MPI frames.

    Returns:
        The range of planes of every ray in every MPI, and the affine maps from disparity to (u, v).

    Source: paper, sec. III-B ("sample and merge", forward-facing check); docs/how_it_works.md, "Intersected planes".
    """
    o, d = local_rays(origins, directions, frames)
    dz, oz = d[..., 2], o[..., 2]
    facing = dz > FACING_EPS
    safe_dz = torch.where(facing, dz, torch.ones_like(dz))
    slope_u, slope_v = d[..., 0] / safe_dz, d[..., 1] / safe_dz
    bend_u, bend_v = o[..., 0] - oz * slope_u, o[..., 1] - oz * slope_v
    u0, u1, v0, v1 = frames.extents.unbind(-1)
    inverse_far = 1.0 / fars
    one = torch.ones_like(oz)
    p = torch.stack([dz * nears + oz, -(dz + oz * inverse_far), bend_u, -bend_u, bend_v, -bend_v])
    q = torch.stack([one, -inverse_far * one, u1 - slope_u, slope_u - u0, v1 - slope_v, slope_v - v0])

    low, high = _intersected_range(p, q, oz, frames)
    count = torch.where(facing, (high - low + 1).clamp(min=0), torch.zeros_like(high))
    return PlaneHits(
        m_first=high.to(torch.int64),
        count=count.to(torch.int64),
        u=torch.stack([slope_u, bend_u], -1),
        v=torch.stack([slope_v, bend_v], -1),
        local_origins=o,
        local_directions=d,
    )


def _intersected_range(
    p: Float[Tensor, "C R K"], q: Float[Tensor, "C R K"], oz: Float[Tensor, "R K"], frames: Frames
) -> tuple[Float[Tensor, "R K"], Float[Tensor, "R K"]]:
    """Smallest and largest m of a plane with p w <= q for all C conditions (low > high: none)."""
    last, step, end = (frames.num_planes - 1).to(oz.dtype), frames.disparity_steps, frames.last_disparities
    slope, offset = p * step, q - p * end
    bound = offset / torch.where(slope == 0, torch.ones_like(slope), slope)
    upper = torch.where(slope > 0, bound, torch.full_like(bound, torch.inf)).amin(0)
    lower = torch.where(slope < 0, bound, torch.full_like(bound, -torch.inf)).amax(0)
    never = (((slope == 0) & (offset < 0)) | bound.isnan()).any(0)  # NaN: a ray from nowhere
    high = torch.minimum(upper.floor(), last).clamp(min=-1)
    low = torch.minimum(lower.ceil().clamp(min=0), last + 1)
    low, high = torch.where(never, last + 1, low), torch.where(never, torch.full_like(high, -1), high)

    def is_intersected(m: Float[Tensor, "R K"]) -> Bool[Tensor, "R K"]:
        w = sample_disparity(m, step, end)
        return (p * w <= q).all(0) & (w * oz < 1) & (m >= 0) & (m <= last)

    # The division may be off by one plane at a border: the half-space test itself decides.
    high = torch.where(is_intersected(high + 1), high + 1, torch.where(is_intersected(high), high, high - 1))
    low = torch.where(is_intersected(low - 1), low - 1, torch.where(is_intersected(low), low, low + 1))
    return low, high


def sample_disparity(m: Tensor, step: Tensor, end: Tensor) -> Tensor:
    """Disparity of plane m = L - 1 - l: ``end`` (1 / far) for the last one, exactly 0 at infinity."""
    return m.to(step.dtype) * step + end


def inverse_distance(w: Tensor, oz: Tensor, dz: Tensor) -> Tensor:
    """1/t at which a ray (local z of origin and direction) reaches disparity w; finite, and 0 at infinity."""
    return w * dz / (1 - w * oz)


def local_to_ndc(
    local: Float[Tensor, "N K 3"], inverse_t: Float[Tensor, "N 1"], frames: Frames
) -> tuple[Float[Tensor, "N K 3"], Bool[Tensor, "N K"]]:
    """NDC of homogeneous points (x/t, 1/t) in each MPI, and whether they lie inside its frustum.

    Args:
        local: x / t in the MPI's axes, relative to its origin; a direction for a point at infinity.
        inverse_t: 1 / t, 0 at infinity.
        frames: the K MPI frames.

    Returns:
        NDC (u, v, s), each normalised to [-1, 1] over the frustum (s: near plane -1, last plane +1), and the inside
        mask. Where a point lies behind an MPI its NDC is meaningless (finite) and the mask is False.
    """
    z = local[..., 2]
    ahead = z > 0
    safe_z = torch.where(ahead, z, torch.ones_like(z))
    u0, u1, v0, v1 = frames.extents.unbind(-1)
    u = 2 * (local[..., 0] / safe_z - u0) / (u1 - u0) - 1
    v = 2 * (local[..., 1] / safe_z - v0) / (v1 - v0) - 1
    scale = frames.nears / frames.depth_shares
    s = 1 - (2 * scale * inverse_t / safe_z - 2 * scale * frames.last_disparities)
    ndc = torch.stack([u, v, s], -1)
    # A few ulps of slack: a sample on the border of its own MPI stays inside after the round trip. In s those are ulps
    # of 1 / near over the disparities between near and far.
    slack = torch.stack([torch.ones_like(scale), torch.ones_like(scale), 1 / frames.depth_shares], -1)
    inside = ahead & (ndc.abs() <= 1 + 16 * torch.finfo(ndc.dtype).eps * slack).all(-1)
    return torch.where(ahead[..., None], ndc, torch.zeros_like(ndc)), inside


@dataclass(frozen=True)
class Cube:
    """The centred cube: its bounds as tensors, and the distance between samples."""

    lower: Float[Tensor, "3"]
    upper: Float[Tensor, "3"]
    step: float

    @staticmethod
    def pack(
        plan: CubePlan, samples_per_voxel: float, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> Cube:
        lower = torch.tensor(plan.lower, dtype=dtype, device=device)
        upper = torch.tensor(plan.upper, dtype=dtype, device=device)
        sides = [(b - a) / (n - 1) for a, b, n in zip(plan.lower, plan.upper, reversed(plan.shape), strict=True)]
        return Cube(lower, upper, min(sides) / samples_per_voxel)

    def normalised(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """World points to [-1, 1]^3 over the cube."""
        return 2 * (points - self.lower) / (self.upper - self.lower) - 1


def cube_hits(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    nears: Float[Tensor, "R 1"],
    fars: Float[Tensor, "R 1"],
    cube: Cube,
) -> tuple[Int[Tensor, "R"], Int[Tensor, "R"]]:
    """First sample index and number of samples inside the cube; sample i lies at distance (i + 1/2) step.

    Slab test; a direction component of 0 gives no bound inside its slab and no hit outside it.
    """
    flat = directions == 0
    safe = torch.where(flat, torch.ones_like(directions), directions)
    t_a, t_b = (cube.lower - origins) / safe, (cube.upper - origins) / safe
    inside = (origins >= cube.lower) & (origins <= cube.upper)
    enter = torch.where(flat, torch.where(inside, -torch.inf, torch.inf), torch.minimum(t_a, t_b)).amax(-1)
    leave = torch.where(flat, torch.where(inside, torch.inf, -torch.inf), torch.maximum(t_a, t_b)).amin(-1)
    enter = torch.maximum(enter, nears[:, 0])
    leave = torch.minimum(leave, fars[:, 0])
    longest = 2 * torch.linalg.vector_norm(cube.upper - cube.lower) / cube.step
    first = (enter / cube.step - 0.5).ceil()
    count = ((leave / cube.step - 0.5).floor() - first + 1).clamp(min=0)
    hit = (enter <= leave) & torch.isfinite(first) & (count <= longest)
    first, count = torch.where(hit, first, torch.zeros_like(first)), torch.where(hit, count, torch.zeros_like(count))
    return first.to(torch.int64), count.to(torch.int64)
