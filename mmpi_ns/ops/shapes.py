"""Shapes at the border to C++ and Triton, which read and write memory by them and check nothing."""

from __future__ import annotations

import functools

from torch import Tensor


def check_shapes(forms: str, *tensors: Tensor | None, **sizes: int) -> dict[str, int]:
    """Sizes of tensors by letter, of which each must be the same wherever it occurs.

    Args:
        forms: name and sizes of every tensor, separated by commas: "positions N 4, values N C".
        tensors: in that order; None passes.
        sizes: letters that something else has set, such as the rows of a table or the heads of a layout.

    Returns:
        The size that each letter stands for.

    Raises:
        ValueError: a tensor has another shape (names it).
    """
    for (name, *form), tensor in zip(_parsed(forms), tensors, strict=True):
        if tensor is None:
            continue
        expected = [sizes.setdefault(x, n) if isinstance(x, str) else x for x, n in zip(form, tensor.shape)]  # noqa: B905
        if len(form) != tensor.ndim or expected != list(tensor.shape):
            letters = {x: sizes[x] for x in form if x in sizes}
            raise ValueError(f"{name} has the shape {list(tensor.shape)} where {form} is needed, with {letters}")
    return sizes


@functools.cache
def _parsed(forms: str) -> list[list[str | int]]:
    return [[int(x) if x.isdigit() else x for x in form.split()] for form in forms.split(",")]
