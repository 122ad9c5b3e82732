"""Exports of trained scenes for use without nerfstudio: baked scenes, web page, splats.

``scene = mmpi_show.load(folder)`` reads a baked scene, and ``mmpi_ns.render`` renders images of it.
"""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    """``load``, imported when it is first accessed: torch and nerfstudio take seconds."""
    if name != "load":
        raise AttributeError(f"module 'mmpi_show' has no attribute '{name}'")
    from mmpi_show.files import load

    return load
