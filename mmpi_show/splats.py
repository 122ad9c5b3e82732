"""A baked window as flat Gaussians ("splats"), in the file format of 3D Gaussian splatting viewers.

A texel that training rays see becomes a Gaussian in its plane. Similar neighbours are merged. A splat's colour is
fitted to the colours of rays through it, as a linear function of the direction: spherical harmonics of degree 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from jaxtyping import Float, Int
from rich.progress import track
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from mmpi_ns.ops.gather import COLORS, activate
from mmpi_ns.utils.files import write_atomically
from mmpi_ns.utils.parallel import in_order, torch_apart
from mmpi_show.files import Pose
from mmpi_show.ops.splat import BLUR, Gaussians, splat_errors, splat_image
from mmpi_show.scene import CELLS, SIDE
from mmpi_show.windows import BakedWindow

WIDTH = 0.35
"""Standard deviation of a splat, in texels."""
THICKNESS = 0.01
"""Thickness of a splat, relative to its width."""
LARGEST = 3
"""Maximum number of times that four neighbours are merged into one."""
AGREEING_COLOR, AGREEING_FEATURE, AGREEING_ALPHA = 0.04, 0.2, 0.1
"""Neighbours whose colours, features and alphas differ by less are merged."""
DENSER = 1.25
"""Factor on optical depths."""
FRACTIONS = (0.0, 0.5, 0.25, 0.75)
"""Camera positions of each round of fitting, as fractions of the way from one camera to the next."""
STEP = 1.5
"""Step size of a round; above 1 is over-relaxation."""
OPACITY_STEP, MOST_CHANGE = 0.3, 1.0
"""Step size for logits of opacities, which move together with the colours (at 1 both overshoot), and maximum step."""
STEADY = 0.02
"""Regularisation towards a view-independent colour, relative to the weight of a splat."""
SH0, SH1 = 0.28209479177387814, 0.4886025119029199
"""Spherical harmonics: the constant one, and the factor of those of degree 1, -y, z and -x."""


@dataclass(frozen=True)
class Splats:
    """N Gaussians."""

    means: Float[Tensor, "N 3"]
    """World axes, scene units."""
    scales: Float[Tensor, "N 3"]
    """Standard deviations along their own axes."""
    rotations: Float[Tensor, "N 4"]
    """Unit quaternions (w, x, y, z): own axes to the world's."""
    alphas: Float[Tensor, "N"]
    """Opacities at their centres."""
    colors: Float[Tensor, "N 4 3"]
    """Red, green and blue seen in direction d are these times (1, d)."""

    @property
    def gaussians(self) -> Gaussians:
        turns = torch.tensor(Rotation.from_quat(self.rotations[:, [1, 2, 3, 0]].numpy()).as_matrix()).float()
        half = turns * self.scales[:, None]
        return Gaussians(self.means, half @ half.mT, self.alphas)

    def basis(self, eye: Float[Tensor, "3"]) -> Float[Tensor, "N 4"]:
        """Directional basis (1, d) of each splat, seen from a point."""
        directions = torch.nn.functional.normalize(self.means - eye, dim=-1)
        return torch.cat([torch.ones_like(directions[:, :1]), directions], -1)


@dataclass(frozen=True)
class _Texels:
    """Texels of a window, each once, even if two bricks contain it."""

    places: Int[Tensor, "T 4"]
    """MPI, plane, row, column."""
    depths: Float[Tensor, "T"]
    """Optical depths."""
    channels: Float[Tensor, "T C"]
    """Colours and features."""
    peaks: Float[Tensor, "T"]


@torch_apart()
def splats_of(window: BakedWindow, poses: list[Pose], least: float, most: int, rounds: int = len(FRACTIONS)) -> Splats:
    """A baked window as splats.

    Args:
        window: baked.
        poses: training cameras.
        least: texels of less weight in all these views are dropped.
        most: maximum number of splats; those with the largest weights are kept.
        rounds: of fitting colours to renderings of the window.

    Raises:
        ValueError: if no texel has the least weight.
    """
    texels = _texels(window, window.peaks(pose.rays() for pose in poses))
    group, level = _merged(texels, least, most)
    focal = fmean(pose.focal[0] for pose in poses)
    inside = (group >= 0).nonzero()[:, 0]
    group, level, total = group[inside], level[inside], int(group.max()) + 1
    count = torch.bincount(group, minlength=total).float()
    values = torch.cat([texels.places[:, 2:].float(), texels.depths[:, None], texels.channels[:, :COLORS]], -1)[inside]
    average = torch.zeros(total, values.shape[1]).index_add(0, group, values) / count[:, None]
    (y, x, depth), colors = average[:, :3].unbind(-1), average[:, 3:]
    first = torch.empty_like(count, dtype=torch.int64).index_copy(0, group, inside)
    head, plane = texels.places[first, :2].unbind(-1)
    size = 2.0 ** torch.empty_like(first).index_copy(0, group, level)
    means, scales = torch.empty(total, 3), torch.empty(total, 3)
    rotations, alphas = torch.empty(total, 4), torch.empty(total)
    for k, mpi in enumerate(window.mpis.mpis):
        in_mpi = head == k
        u0, u1, v0, v1 = mpi.extent
        du, dv = (u1 - u0) / (mpi.width - 1), (v1 - v0) / (mpi.height - 1)
        disparity = (mpi.planes - 1 - plane[in_mpi]) * mpi.disparity_step + 1 / mpi.far
        z = 1 / disparity.clamp(min=1 / window.farthest)
        local = torch.stack([(u0 + x[in_mpi] * du) * z, (v0 + y[in_mpi] * dv) * z, z], -1)
        means[in_mpi] = torch.tensor(mpi.origin) + local @ torch.tensor(mpi.axes)
        sides = torch.stack([size[in_mpi] * du, size[in_mpi] * dv], -1)
        scales[in_mpi] = torch.cat([WIDTH * sides, THICKNESS * sides[:, :1]], -1) * z[:, None]
        qx, qy, qz, qw = Rotation.from_matrix(np.transpose(mpi.axes)).as_quat()
        rotations[in_mpi] = torch.tensor([qw, qx, qy, qz], dtype=torch.float32)
        # Overlapping splats of this spacing sum to this multiple of their centre value, after a rasteriser's blur.
        overlap = 2 * math.pi * (WIDTH**2 + BLUR / (focal * sides) ** 2).prod(-1).sqrt()
        alphas[in_mpi] = -torch.expm1(-DENSER * depth[in_mpi] / overlap)
    colors = torch.cat([colors[:, None], torch.zeros(total, 3, COLORS)], 1)
    splats = Splats(means, scales, rotations, alphas.clamp(max=0.999), colors)
    # Other cameras each time, so that splats do not overfit to those of the capture.
    for number, fraction in enumerate(FRACTIONS[:rounds]):
        cameras = between(poses, fraction)
        splats = fitted(splats, window, track(cameras, description=f"Fitting splats, round {number + 1} of {rounds}"))
    return splats


def between(poses: list[Pose], fraction: float) -> list[Pose]:
    """Cameras interpolated at a fraction of the way from each to the next."""
    cameras = []
    for a, b in zip(poses, [*poses[1:], poses[-1]], strict=True):
        (a_turn, a_eye), (b_turn, b_eye) = ((x[:, :3], x[:, 3:]) for x in (np.array(a.to_world), np.array(b.to_world)))
        turn = Slerp([0, 1], Rotation.from_matrix([a_turn, b_turn]))(fraction).as_matrix()
        cameras.append(replace(a, to_world=np.hstack([turn, a_eye + fraction * (b_eye - a_eye)]).tolist()))
    return cameras


def fitted(splats: Splats, window: BakedWindow, poses: Iterable[Pose]) -> Splats:
    """One round of fitting colours, linear in direction, and opacities to renderings of a window.

    The errors of all images are propagated to the splats, and each splat is corrected by least squares over
    (1, direction), independently of the others. Weights of a pixel sum to at most 1, so steps below 2 converge. An
    error is distributed among opacities in proportion to their effect on the pixel.
    """
    gaussians, count = splats.gaussians, len(splats.means)
    squares, errors, opacities = torch.zeros(count, 4, 4), torch.zeros(count, 4, COLORS), torch.zeros(count, 2)

    def errors_in(pose: Pose) -> tuple[Tensor, Tensor]:
        basis = splats.basis(torch.tensor(pose.to_world)[:, 3])
        colors = (basis[:, :, None] * splats.colors).sum(1).clamp(0, 1)
        image = splat_image(gaussians, pose, colors)
        rendered = image[..., :3] + window.background * image[..., 3:]
        missing = window.render(*pose.rays())["rgb"].view(rendered.shape) - rendered
        return basis, splat_errors(gaussians, pose, colors, rendered, missing)

    for basis, sums in in_order(errors_in, poses):
        opacities += sums[:, 4:]
        seen = sums[:, 3].nonzero()[:, 0]
        basis, sums = basis[seen], sums[seen]
        squares.index_add_(0, seen, basis[:, :, None] * basis[:, None] * sums[:, 3, None, None])
        errors.index_add_(0, seen, basis[:, :, None] * sums[:, None, :3])
    weight = squares[:, :1, 0].clamp(min=1e-6)
    held = STEADY * weight * squares.new_tensor([1e-4, 1.0, 1.0, 1.0])
    colors = splats.colors + STEP * torch.linalg.solve(squares + torch.diag_embed(held), errors)
    change = OPACITY_STEP * opacities[:, 0] / opacities[:, 1].clamp(min=1e-6)
    alphas = torch.sigmoid(torch.logit(splats.alphas, 1e-4) + change.clamp(-MOST_CHANGE, MOST_CHANGE))
    return replace(splats, colors=colors, alphas=alphas.clamp(max=0.999))


def _texels(window: BakedWindow, peaks: Float[Tensor, "B 8 8"]) -> _Texels:
    mpis, keys, steps = window.mpis, torch.full(peaks.shape, -1), torch.arange(SIDE)
    sizes = torch.tensor([[m.planes, m.height, m.width] for m in mpis.mpis])
    starts = torch.cat([torch.zeros(1, dtype=torch.int64), sizes.prod(1).cumsum(0)])
    for k, (mpi, numbers) in enumerate(zip(mpis.mpis, mpis.brick_numbers(), strict=True)):
        plane, row, column = ((numbers >= 0).nonzero()).unbind(-1)
        y, x = (row * CELLS)[:, None, None] + steps[:, None], (column * CELLS)[:, None, None] + steps
        key = (plane[:, None, None] * mpi.height + y) * mpi.width + x + starts[k]
        keys[numbers[plane, row, column].to(torch.int64)] = torch.where((y < mpi.height) & (x < mpi.width), key, -1)
    inside = keys.flatten() >= 0
    texels, flat = keys.flatten()[inside].unique(return_inverse=True)
    codes = torch.cat([mpis.density[..., None], mpis.texels], -1).flatten(0, 2)[inside]
    codes = codes.new_zeros(len(texels), codes.shape[1]).index_copy(0, flat, codes).float()
    head = torch.searchsorted(starts, texels, right=True) - 1
    place, (_, height, width) = texels - starts[head], sizes[head].unbind(-1)
    places = torch.stack([head, place // (height * width), place // width % height, place % width], -1)
    depths = torch.empty(len(texels))
    for k in range(len(mpis.mpis)):
        depths[head == k] = mpis.optical_depth(k, codes[head == k, 0])
    low, step = (torch.tensor([getattr(c, name) for c in mpis.channel_codes]) for name in ("low", "step"))
    channels = activate(low + step * codes[:, 1:])
    highest = torch.zeros(len(texels)).scatter_reduce(0, flat, peaks.flatten()[inside], "amax")
    return _Texels(places, depths, channels, highest)


def _merged(texels: _Texels, least: float, most: int) -> tuple[Int[Tensor, "T"], Int[Tensor, "T"]]:
    """Splat of each texel of at least this weight (-1 for the others, and for all but the ``most`` splats of largest
    weight), and the number of times that four became one in it."""
    is_seen = texels.peaks >= least
    if not is_seen.any():
        raise ValueError(f"No texel has a rendering weight of {least:g} in a training view: give a smaller --weight.")
    tolerance = texels.channels.new_tensor([AGREEING_ALPHA] + [AGREEING_COLOR] * COLORS)
    tolerance = torch.cat([tolerance, tolerance.new_full((texels.channels.shape[1] - COLORS,), AGREEING_FEATURE)])
    values = torch.cat([-torch.expm1(-texels.depths)[:, None], texels.channels], -1)[is_seen] / tolerance
    head, plane, y, x = texels.places[is_seen].unbind(-1)
    wide = int(texels.places.max()) + 1
    level = torch.zeros_like(x)

    def cells(depth: int | Tensor) -> Tensor:
        return ((head * wide + plane) * wide + (y >> depth)) * wide + (x >> depth)

    for depth in range(1, LARGEST + 1):
        _, parent, count = cells(depth).unique(return_inverse=True, return_counts=True)
        index = parent[:, None].expand(values.shape)
        none = values.new_zeros(len(count), values.shape[1])
        high, low = (none.scatter_reduce(0, index, values, how, include_self=False) for how in ("amax", "amin"))
        agrees = (count == 4**depth) & ((high - low).amax(-1) < 1)
        level = torch.where(agrees[parent], depth, level)
    _, group = (cells(level) * (LARGEST + 1) + level).unique(return_inverse=True)
    weight = torch.zeros(int(group.max()) + 1).scatter_reduce(0, group, texels.peaks[is_seen], "amax")
    heaviest = weight.argsort(descending=True)[:most].sort().values
    numbers = torch.full((len(weight),), -1).index_copy(0, heaviest, torch.arange(len(heaviest)))
    groups, levels = torch.full(is_seen.shape, -1), torch.zeros(is_seen.shape, dtype=torch.int64)
    groups[is_seen], levels[is_seen] = numbers[group], level
    return groups, levels


def write_ply(splats: Splats, path: Path) -> int:
    """Writes the layout of Kerbl et al. (2023): logits of opacity, logarithms of scales, spherical harmonics.

    Returns:
        Bytes that were written.

    Raises:
        OSError: the disk is full or cannot be written.
    """
    constant, x, y, z = (splats.colors[:, i] for i in range(4))
    harmonics = torch.stack([-y, z, -x], -1) / SH1  # [N, colour, 3]
    columns = torch.cat([
        splats.means, torch.zeros_like(splats.means), (constant - 0.5) / SH0, harmonics.flatten(1),
        torch.logit(splats.alphas, 1e-4)[:, None], splats.scales.log(), splats.rotations,
    ], -1).numpy().astype("<f4")  # fmt: skip
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(9)), "opacity",
             *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]  # fmt: skip
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(columns)}"]
    lines += [*(f"property float {name}" for name in names), "end_header", ""]
    data = "\n".join(lines).encode() + np.ascontiguousarray(columns).tobytes()
    write_atomically(path, lambda unfinished: unfinished.write_bytes(data))
    return len(data)
