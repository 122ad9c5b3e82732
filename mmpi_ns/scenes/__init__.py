"""Procedural scenes with exact geometry, plain NumPy: ``make_scene``, ``render``, ``sfm_points``, ``write_dataset``."""

from mmpi_ns.scenes.catalogue import SCENES, make_scene
from mmpi_ns.scenes.dataset import write_dataset
from mmpi_ns.scenes.scene import Cameras, Scene, render
from mmpi_ns.scenes.sfm_like import SfmPoints, sfm_points

__all__ = ["SCENES", "Cameras", "Scene", "SfmPoints", "make_scene", "render", "sfm_points", "write_dataset"]
