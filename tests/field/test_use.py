"""What bricks are used for, against loops in float64."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from compiled import normal

from mmpi_ns.field.tables import TexelTables
from mmpi_ns.ops.gather import Taps
from mmpi_ns.ops.interpolate import index_rows
from mmpi_ns.scene.texels import BRICK

BRICKS, RAYS = 40, 90


def use(read, seed=0):
    """Rows, taps, rays, weights, errors, peaks and gains of samples that read these rows of tables."""
    g, index = torch.Generator().manual_seed(seed), index_rows(torch.as_tensor(read), BRICKS * BRICK)
    rays = torch.randint(0, RAYS, (len(read),), generator=g).sort().values
    weights, errors = normal(len(read), seed=seed).abs(), normal(RAYS, seed=seed + 1).abs()
    weights[: len(read) // 5] = 0
    records = (0.1 * normal(BRICKS, seed=seed + 2).abs() for _ in range(2))
    return index.unique, Taps(index.positions, torch.ones(read.shape)), rays, weights, errors, *records


def by_loops(rows, taps, rays, weights, errors, peak, gain):
    """New peaks, and gains summed in float64."""
    peaks, gains = peak.tolist(), gain.tolist()
    for read, ray, weight in zip(rows[taps.positions.long()].tolist(), rays.tolist(), weights.tolist(), strict=True):
        for row in read:
            peaks[row // BRICK] = max(peaks[row // BRICK], weight)
        gains[read[0] // BRICK] += weight * float(errors[ray])
    return peaks, gains


def cells(count, seed=0, most=BRICKS * BRICK):
    """Rows of samples on planes: four neighbours in a brick or in four of them."""
    g = torch.Generator().manual_seed(seed)
    first = torch.randint(0, most - 9, (count, 1), generator=g) + torch.tensor([0, 1, 8, 9])
    anywhere = torch.randint(0, most, (count, 4), generator=g)
    return torch.where(torch.arange(count)[:, None] % 4 > 0, first, anywhere)


CASES = {
    "planes": cells(700, seed=3),
    "with a cube": torch.cat([cells(500, seed=4), cells(500, seed=5)], 1),
    "one brick": 7 * BRICK + cells(400, seed=6, most=BRICK),
    "one row": torch.full((300, 4), 1234),
    "the first and the last row": torch.tensor([[0, BRICKS * BRICK - 1] * 2] * 9),
    "one sample": cells(1),
    "no sample": cells(0),
}


def noted(arguments):
    """Peaks and gains afterwards."""
    rows, taps, rays, weights, errors, *records = arguments
    peak, gain = (x.clone() for x in records)
    field = SimpleNamespace(peak=peak, gain=gain, num_copies=0, crossings=0)
    samples = SimpleNamespace(rays=rays, num_intersected=rays)
    TexelTables.note_use(field, SimpleNamespace(rows=rows, taps=taps), samples, weights, errors)
    return [peak, gain]


@pytest.mark.parametrize("case", CASES)
def test_peaks_and_gains_are_those_of_loops(case):
    arguments = use(CASES[case])
    (peak, gain), (peaks, gains) = noted(arguments), by_loops(*arguments)
    assert peak.tolist() == peaks and gain.tolist() == pytest.approx(gains, rel=1e-6)
    if len(arguments[2]) > 1:
        assert (peak > arguments[5]).any() and (gain > arguments[6]).any()


def test_samples_without_weight_change_nothing():
    rows, taps, rays, weights, *rest = use(CASES["planes"])
    arguments = (rows, taps, rays, 0 * weights, *rest)
    assert all(torch.equal(a, b) for a, b in zip(noted(arguments), rest[1:], strict=True))


def test_a_weight_that_is_not_a_number_is_seen_and_stays():
    rows, taps, rays, weights, *rest = use(CASES["one row"])
    weights[5] = math.nan
    peak, gain = noted((rows, taps, rays, weights, *rest))
    assert peak.isnan().nonzero().tolist() == gain.isnan().nonzero().tolist() == [[1234 // BRICK]]
