"""Point clouds in PLY files."""

from __future__ import annotations

import numpy as np
import torch

from mmpi_ns.data.dataset import GRAY, parser_points


def test_points_without_colours_are_gray_and_keep_all_their_digits(tmp_path):
    head = ["ply", "format ascii 1.0", "element vertex 2", *(f"property double {c}" for c in "xyz"), "end_header", ""]
    path = tmp_path / "map.ply"
    path.write_text("\n".join(head) + "455000.123456789 5411000.25 -1\n0 0 0\n")
    origin = np.array([455000.0, 5411000.0, -2.0])
    points = parser_points(path, torch.eye(4)[:3], 1.0, origin)
    torch.testing.assert_close(points["points3D_xyz"][0], torch.tensor([0.123456789, 0.25, 1.0]), rtol=1e-7, atol=0)
    assert points["points3D_rgb"].tolist() == [[GRAY] * 3] * 2
