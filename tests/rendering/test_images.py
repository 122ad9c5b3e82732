"""The order in which the pixels of an image are rendered."""

from itertools import pairwise

import pytest
import torch

from mmpi_ns.rendering.images import SQUARE, square_by_square


@pytest.mark.parametrize("height, width", [(8, 12), (9, 6), (3, 50), (1, 1)])
def test_every_pixel_has_one_place_and_squares_are_together(height, width):
    order = square_by_square(height, width, torch.device("cpu"))
    assert order.sort().values.tolist() == list(range(height * width))
    seen = [(n // width // SQUARE, n % width // SQUARE) for n in order.tolist()]
    changes = [b for a, b in pairwise(seen) if a != b]
    assert len(changes) + 1 == len(set(seen))  # no square is left and entered again
