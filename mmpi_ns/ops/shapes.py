"""Shapes at the border to C++ and Triton, which read and write memory by them and check nothing."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from typing import Any, get_args, get_type_hints

from torch import Tensor


def check_shapes(owner: Callable[..., Any], values: Mapping[str, Any], sizes: dict[str, int] | None = None) -> None:
    """Compares tensors with their annotations: a letter stands for one size wherever it occurs.

    Tensors within named tuples are compared too; those of each dataclass in a list have letters of their own.

    Args:
        owner: a function or class with annotations such as ``Float[Tensor, "R S 3"]``.
        values: its arguments or fields by name. What has ``sizes`` (a layout, a baked scene) sets letters first.
        sizes: letters that are set already; others are added.

    Raises:
        ValueError: a tensor has another shape (names it).
    """
    letters = {} if sizes is None else sizes
    for value in values.values():
        letters |= {} if isinstance(value, Tensor) else getattr(value, "sizes", {})
    for name, value in values.items():
        if isinstance(value, Tensor):
            form = _annotated(owner).get(name)
            if form is None:
                continue
            expected = [letters.setdefault(x, n) if isinstance(x, str) else x for x, n in zip(form, value.shape)]  # noqa: B905
            if len(form) != value.ndim or expected != list(value.shape):
                needed = f"{list(form)} is needed, with { {x: n for x, n in letters.items() if x in form} }"
                raise ValueError(f"{name} has the shape {list(value.shape)} where {needed}")
        elif isinstance(value, tuple) and hasattr(value, "_fields"):
            check_shapes(type(value), value._asdict(), letters)  # type: ignore[attr-defined]
        elif isinstance(value, list):
            for each in filter(is_dataclass, value):
                check_shapes(type(each), vars(each))


@functools.cache
def _annotated(owner: Callable[..., Any]) -> dict[str, tuple[str | int, ...]]:
    """Sizes of the tensors of an owner by name; those of any shape are left out."""
    forms = {}
    for name, hint in get_type_hints(owner).items():
        texts = [t for part in (hint, *get_args(hint)) if isinstance(t := getattr(part, "dim_str", None), str)]
        if texts and "..." not in texts[0]:
            forms[name] = tuple(int(x) if x.isdigit() else x for x in texts[0].split())
    return forms
