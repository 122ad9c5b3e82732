"""What nerfstudio's methods lack on a bare machine: a reader of point clouds that does not need open3d."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "uchar": "u1", "uint8": "u1", "int": "i4"}


def read_ply(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Positions [P, 3] and colours [P, 3] of a PLY file, text or little-endian.

    Raises:
        ValueError: it is no such file.
    """
    data = path.read_bytes()
    end = data.find(b"end_header")
    head = data[: max(end, 0)].decode("ascii", errors="replace").splitlines()
    words = [line.split() for line in head if line.strip()]
    form = next((w[1] for w in words if w[0] == "format"), "")
    elements = [w for w in words if w[0] == "element"]
    if form not in ("ascii", "binary_little_endian") or not elements or elements[0][1] != "vertex":
        raise ValueError(f"{path} is not a PLY file of points (text or little-endian): write it again.")
    stop = words.index(elements[1]) if len(elements) > 1 else len(words)
    columns = [(w[2], TYPES[w[1]]) for w in words[words.index(elements[0]) : stop] if w[0] == "property"]
    count, body = int(elements[0][2]), data[data.index(b"\n", end) + 1 :]
    if form == "ascii":
        numbers = np.array(body.split()[: count * len(columns)], np.float64).reshape(count, len(columns))
        table = {name: numbers[:, i] for i, (name, _) in enumerate(columns)}
    else:
        rows = np.frombuffer(body, np.dtype([(n, "<" + t) for n, t in columns]), count)
        table = {name: rows[name] for name, _ in columns}
    xyz = np.stack([table[k] for k in "xyz"], -1).astype(np.float32)
    return xyz, np.stack([table[k] for k in ("red", "green", "blue")], -1).astype(np.uint8)


def read_points_ourselves() -> None:
    """Makes nerfstudio's data parser read point clouds by ``read_ply`` in this process.

    open3d, by which it would, is often absent from a machine, or there without the system's libraries that it needs.
    """
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio

    def load(self, ply_file_path: Path, transform_matrix: torch.Tensor, scale_factor: float):
        xyz, rgb = read_ply(ply_file_path)
        if not len(xyz):
            return None
        points = torch.from_numpy(xyz)
        points = torch.cat([points, torch.ones_like(points[:, :1])], -1) @ transform_matrix.T * scale_factor
        return {"points3D_xyz": points, "points3D_rgb": torch.from_numpy(rgb)}

    Nerfstudio._load_3D_points = load  # type: ignore[method-assign]
