"""MMPI: radiance fields of several multi-plane images, for nerfstudio's commands and as functions.

``scene = mmpi_ns.load(path)`` reads a run, and ``mmpi_ns.render(scene, camera_to_worlds, intrinsics, width, height)``
renders images of it (``functional.py``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mmpi_ns.functional import CameraPath, Images, Scene, load, render

__all__ = ["CameraPath", "Images", "Scene", "load", "render"]


def __getattr__(name: str) -> Any:
    """One of the functions above, imported when it is first accessed: torch and nerfstudio take seconds."""
    if name not in __all__:
        raise AttributeError(f"module 'mmpi_ns' has no attribute '{name}'")
    from mmpi_ns import functional

    return getattr(functional, name)
