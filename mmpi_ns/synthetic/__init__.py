"""Procedural scenes with exact geometry, plain NumPy: ``make_scene``, ``render``, ``sfm_points``, ``write_dataset``."""

from mmpi_ns.synthetic.cameras import Cameras
from mmpi_ns.synthetic.catalogue import SCENES, make_scene
from mmpi_ns.synthetic.dataset import write_dataset
from mmpi_ns.synthetic.scene import Scene, render
from mmpi_ns.synthetic.sfm_like import SfmPoints, sfm_points

__all__ = ["SCENES", "Cameras", "Scene", "SfmPoints", "make_scene", "render", "sfm_points", "write_dataset"]
