"""Sixteen numbers at once, in registers of every width that this processor has (ops/cpp/lanes.h)."""

from __future__ import annotations

import ctypes
import platform
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mmpi_ns.ops import build
from mmpi_ns.ops.dispatch import fault

pytestmark = pytest.mark.skipif(fault("C++") is not None, reason="needs a C++ compiler")
SOURCE = Path(__file__).parents[1] / "lanes.cpp"
FORBIDDEN = {4: ["-mno-avx"], 8: ["-mno-avx512f"], 16: []}
"""Instructions that are not used, by the width of the registers."""


@pytest.mark.parametrize("width", FORBIDDEN)
def test_registers_of_every_width_give_the_same(width, tmp_path):
    target = tmp_path / "lanes.so"
    if FORBIDDEN[width] and platform.machine() != "x86_64":
        pytest.skip("other processors have registers of one width")
    subprocess.run([*build.compiler(), *build.FLAGS, *FORBIDDEN[width], str(SOURCE), "-o", str(target)], check=True)
    lanes = ctypes.CDLL(str(target))
    if lanes.width_of_registers() != width:
        pytest.skip(f"this processor has registers of {lanes.width_of_registers()} numbers at most")
    g = np.random.default_rng(0)
    x, y = (g.normal(0, 30, 16).astype(np.float32) for _ in range(2))
    y[[2, 9]], x[5] = x[[2, 9]], y[5] - 1
    codes, results = g.integers(0, 256, 16, dtype=np.uint8), np.empty((10, 16), np.float32)
    lanes.try_lanes(*(ctypes.c_void_p(a.ctypes.data) for a in (x, y, codes, results)))
    wide, whole, i = x.astype(np.float64), x.astype(np.int32), np.arange(16)
    changed = 2 - wide / 3 * y
    changed[3] = changed[12] + 1
    expected = [
        np.exp(wide), np.logaddexp(0, wide), np.where((x < y) & (y != 0), np.minimum(x, y) - 1, np.maximum(x, -y)),
        ((whole << 2) + (whole >> 1)) ^ (whole & 7) | ~whole, codes[i ^ 5], x[i % 8 * 3 & 15], np.abs(x),
        np.full(16, x.max()), np.full(16, sum(1 << k for k in range(16) if x[k] >= y[k])), changed,
    ]  # fmt: skip
    np.testing.assert_allclose(results, expected, rtol=1e-6)
