"""Procedural scenes with exact geometry, plain NumPy: ``make_scene``, ``render``, ``sfm_points``, ``write_dataset``."""

from mmpi_scene.cameras import Cameras
from mmpi_scene.catalogue import SCENES, make_scene
from mmpi_scene.dataset import write_dataset
from mmpi_scene.scene import Scene, render
from mmpi_scene.sfm_like import SfmPoints, sfm_points

__all__ = ["SCENES", "Cameras", "Scene", "SfmPoints", "make_scene", "render", "sfm_points", "write_dataset"]
