"""Tensors of a wrong shape never reach C++ or Triton (ops/shapes.py)."""

from __future__ import annotations

import pytest
import torch

from mmpi_ns.ops.shapes import check_shapes


def test_letters_stand_for_one_size_each():
    sizes = check_shapes("rows N 4, values N C, marks T", torch.zeros(5, 4), torch.zeros(5, 9), torch.zeros(7), T=7)
    assert sizes == {"N": 5, "C": 9, "T": 7}


@pytest.mark.parametrize(
    ("rows", "values"), [((5, 3), (5, 9)), ((5, 4), (6, 9)), ((5,), (5, 9)), ((5, 4), (5, 9, 1)), ((5, 4), (5, 8))]
)
def test_another_shape_is_refused_by_the_tensors_name(rows, values):
    with pytest.raises(ValueError, match=r"(rows|values) has the shape \["):
        check_shapes("rows N 4, values N C", torch.zeros(rows), torch.zeros(values), C=9)


def test_a_tensor_that_is_not_there_passes():
    assert check_shapes("rows N 4, values N C", torch.zeros(2, 4), None) == {"N": 2}
