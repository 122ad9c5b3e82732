"""Point clouds in PLY files."""

from __future__ import annotations

import numpy as np

from mmpi_ns.capture.dataset import GRAY, read_ply


def test_points_without_colours_are_gray_and_keep_all_their_digits(tmp_path):
    head = ["ply", "format ascii 1.0", "element vertex 2", *(f"property double {c}" for c in "xyz"), "end_header", ""]
    path = tmp_path / "map.ply"
    path.write_text("\n".join(head) + "455000.123456789 5411000.25 -1\n0 0 0\n")
    xyz, rgb = read_ply(path)
    assert xyz.dtype == np.float64 and xyz[0].tolist() == [455000.123456789, 5411000.25, -1.0]
    assert rgb.tolist() == [[GRAY] * 3] * 2
