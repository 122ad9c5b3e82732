"""Point clouds in PLY files."""

from __future__ import annotations

import numpy as np

from mmpi_priors.clouds import read_ply


def test_points_keep_all_their_digits(tmp_path):
    head = ["ply", "format ascii 1.0", "element vertex 2", *(f"property double {c}" for c in "xyz"), "end_header", ""]
    path = tmp_path / "map.ply"
    path.write_text("\n".join(head) + "455000.123456789 5411000.25 -1\n0 0 0\n")
    np.testing.assert_array_equal(read_ply(path), [[455000.123456789, 5411000.25, -1], [0, 0, 0]])
