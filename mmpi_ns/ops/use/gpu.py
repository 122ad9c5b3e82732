"""What bricks are used for, on a GPU. Gains are atomic sums: their last bits may differ from run to run."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.gather import Taps
from mmpi_ns.ops.gpu_scene import block_size, launch

SAMPLES = 256
"""Of a program."""


@triton.jit(do_not_specialize=("first", "count", "slots_per_ray", "positions"))
def use_kernel(
    rows, positions, slots, weights, errors, peak, gain, first, count, slots_per_ray,
    TAPS: tl.constexpr, GAINS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A lane a sample; samples without weight change nothing."""
    number = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = number < count
    slot = tl.load(slots + first + number, inside, 0)
    weight = tl.load(weights + slot, inside, 0.0)
    inside = inside & (weight != 0)
    for tap in tl.static_range(TAPS):
        position = tl.load(positions + number.to(tl.int64) * TAPS + tap, inside, 0).to(tl.int64)
        brick = tl.load(rows + position, inside, 0) // 64
        tl.atomic_max(peak + brick, weight, inside, sem="relaxed")
        if GAINS and tap == 0:
            error = tl.load(errors + slot // slots_per_ray, inside, 0.0)
            tl.atomic_add(gain + brick, weight * error, inside, sem="relaxed")


def note_use(
    rows: Tensor, taps: list[Taps], slots: Tensor, weights: Tensor, errors: Tensor, peak: Tensor, gain: Tensor | None
) -> None:
    rows, slots, weights, errors = (x.contiguous() for x in (rows, slots, weights, errors))
    first, block = 0, block_size(SAMPLES, weights.device)
    for each in taps:
        count, taps_each = each.positions.shape
        launch(
            use_kernel, count, block, rows, each.positions.contiguous(), slots, weights, errors, peak,
            peak if gain is None else gain, first, count, weights.shape[1],
            TAPS=taps_each, GAINS=gain is not None, BLOCK=block,
        )  # fmt: skip
        first += count
