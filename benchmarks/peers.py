"""What nerfstudio's methods lack on a bare machine or beside ours: a reader of point clouds that does not need open3d,
lookups in hash tables that are quick without a GPU, no weights of LPIPS, and the depths that our methods find."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData
from torch import Tensor, nn

from mmpi_ns.ops.interpolate import weigh_rows


class NoLPIPS(nn.Module):
    """Stands in for the metric that nerfstudio's models build in their constructors."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__()

    def forward(self, *args: Any) -> Tensor:
        return torch.tensor(float("nan"))


def leave_lpips_out() -> None:
    """Makes nerfstudio's models of this process take ``NoLPIPS``, if they are imported later: the weights of LPIPS may
    be out of reach."""
    import torchmetrics.image.lpip as home

    home.LearnedPerceptualImagePatchSimilarity = NoLPIPS  # type: ignore[misc]


def parser_points(path: Path, transform_matrix: Tensor, scale_factor: float) -> dict[str, Tensor]:
    """The point cloud of a PLY file, moved to the scene's axes [3, 4] and scaled, as nerfstudio's parser returns it."""
    points = PlyData.read(path)["vertex"]
    xyz, rgb = (
        torch.from_numpy(np.stack([np.asarray(points[name]) for name in names], -1))
        for names in (("x", "y", "z"), ("red", "green", "blue"))
    )
    places = (xyz.float() @ transform_matrix[:, :3].T + transform_matrix[:, 3]) * scale_factor
    return {"points3D_xyz": places, "points3D_rgb": rgb}


def read_points_ourselves() -> None:
    """Makes nerfstudio's data parser read point clouds without open3d in this process."""
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio

    Nerfstudio._load_3D_points = lambda self, *given: parser_points(*given)  # type: ignore[method-assign]


def give_depths(data: Path, downscale_factor: int) -> None:
    """Makes nerfstudio's ``DepthDataset`` of this process hold the distances that our methods find of training images.

    They are distances along the ray (``--pipeline.model.is-euclidean-depth True``), 0 where nothing is known.
    """
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
    from nerfstudio.data.datasets.depth_dataset import DepthDataset, InputDataset

    from mmpi_ns.data.datamanager import MMPIDataManagerConfig
    from mmpi_priors.settings import CapturePriorsConfig

    parser = NerfstudioDataParserConfig(data=data, downscale_factor=downscale_factor)
    config = MMPIDataManagerConfig(data=data, dataparser=parser, priors=CapturePriorsConfig())
    manager = config.setup(device="cpu", test_mode="val")
    names, known = manager.train_dataset.image_filenames, manager.priors.depths
    if known is None or known.share == 0:
        raise ValueError(f"{data}: no depth is known of any training pixel.")
    inverse = {name: torch.from_numpy(known.image(i)[..., :1]) for i, name in enumerate(names)}

    def depth_of(self: Any, batch: dict[str, Any]) -> dict[str, Tensor]:
        results = inverse.get(self.image_filenames[batch["image_idx"]], torch.zeros_like(batch["image"][..., :1]))
        return {"depth_image": torch.where(results > 0, 1 / results, 0.0)}

    DepthDataset.__init__ = InputDataset.__init__  # type: ignore[method-assign]
    DepthDataset.get_metadata = depth_of  # type: ignore[method-assign]


HASH_FACTORS = (1, 2654435761, 805459861)
"""nerfstudio's, and Instant-NGP's (Mueller et al. 2022, eq. 4)."""
AT_ONCE = 1024
"""Positions whose rows are computed together, so that what lies between stays in the processor's cache."""


def hash_lookups(self: Any, in_tensor: Tensor) -> Tensor:
    """``HashEncoding.pytorch_fwd`` by our compiled gathering of weighted rows: the same values and gradients of the
    table to rounding, several times faster: features [..., levels x features] at positions [..., 3] in the unit cube.
    Positions get no gradient (nerfacto asks for one and drops it)."""
    positions = in_tensor.detach().reshape(-1, 3)
    shape = (len(positions), len(self.scalings), 8)
    rows = torch.empty(shape, dtype=torch.int32, device=positions.device)
    weights = torch.empty(shape, device=positions.device)
    for begin in range(0, len(positions), AT_ONCE):
        part = slice(begin, begin + AT_ONCE)
        rows[part], weights[part] = hash_rows(self, positions[part])
    results = weigh_rows(self.hash_table, rows.view(-1, 8), weights.view(-1, 8))
    return results.view(*in_tensor.shape[:-1], -1)


def hash_rows(encoding: Any, positions: Tensor) -> tuple[Tensor, Tensor]:
    """The table's rows [N, levels, 8] at the corners of each position's cells, and their weights."""
    scaled = positions.T[..., None] * encoding.scalings.to(positions.device)  # [3, N, levels]
    lower = torch.floor(scaled)
    share = scaled - lower
    # Only the low bits of the products matter, so that they may overflow.
    factors = torch.tensor(HASH_FACTORS, device=lower.device).int()[:, None, None]
    ends = [(e.int() * factors).unbind(0) for e in (lower, torch.ceil(scaled))]
    parts = [p.unbind(0) for p in (1 - share, share)]
    hashed, weights = [], []
    for i, j, k in itertools.product((0, 1), repeat=3):
        hashed.append(ends[i][0] ^ ends[j][1] ^ ends[k][2])
        weights.append(parts[i][0] * parts[j][1] * parts[k][2])
    rows = torch.stack(hashed, -1).bitwise_and_(encoding.hash_table_size - 1)
    return rows.add_(encoding.hash_offset.to(rows.device).int()[:, None]), torch.stack(weights, -1)


def look_up_quickly() -> None:
    """Makes nerfstudio's hash encodings of this process use ``hash_lookups`` wherever they would use plain torch."""
    from nerfstudio.field_components.encodings import HashEncoding

    HashEncoding.pytorch_fwd = hash_lookups  # type: ignore[method-assign]
