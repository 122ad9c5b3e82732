"""``mmpi-scene``: writes a procedural scene as a Nerfstudio data set."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import tyro

from mmpi_ns.scripts.command import run
from mmpi_ns.utils.errors import quoted
from mmpi_scene.dataset import ExposureName

Name = Literal["street", "long-road", "walk", "room", "look-round", "object"]


@dataclass
class SceneCommand:
    """Writes images, exact depths, cameras and SfM-like points of a procedural scene, deterministically."""

    name: tyro.conf.Positional[Name]
    """street: a straight drive. long-road: a winding drive of any length. walk: a hand-held walk down a street, with
    lens distortion. room: a walk around a table, looking in all directions. look-round: nearly one spot of that room.
    object: filmed from all sides."""
    folder: tyro.conf.Positional[Path]
    """Folder to write."""
    width: int | None = None
    """Of the images, pixels."""
    height: int | None = None
    """Of the images, pixels."""
    count: int | None = None
    """Images; the default depends on the scene."""
    length: float | None = None
    """Metres driven or walked (street: 40, long-road: 1000, walk: 60)."""
    seed: int = 0
    """Seed of the scene's random content."""
    points: int | None = None
    """SfM points; by default 4,000, and four a metre on drives of more than a kilometre."""
    noise: float = 0.3
    """Standard deviation of the keypoints' noise, pixels; the points are triangulated from them."""
    outliers: float = 0.02
    """Fraction of wrong points."""
    exposure: ExposureName = "none"
    """auto: gains that follow the content (three-fold), white balance, vignetting and a tone curve, written to
    exposure.json. vignetting: one exposure, half of the light lost in the corners."""
    panorama: bool = False
    """Equirectangular views, --width pixels wide and half as high, without points and depths: for mmpi-prepare."""
    moving: int = 0
    """Number of cars and people that move through a street; exact masks in moving/. Test images are rendered without
    them."""
    images: tyro.conf.FlagConversionOff[bool] = True
    """False: write cameras, points and tracks only."""
    overwrite: bool = False
    """Replace a data set in the folder."""

    def main(self) -> None:
        from rich.progress import track

        from mmpi_ns.utils.files import make_writable
        from mmpi_ns.utils.values import Number, check_options
        from mmpi_scene.cameras import Panoramas
        from mmpi_scene.catalogue import make_scene
        from mmpi_scene.dataset import check_folder, make_exposure, write_dataset
        from mmpi_scene.movers import with_movers

        size = Number(1, 65536, whole=True)
        ranges = {
            "seed": Number(0, whole=True), "noise": Number(0), "outliers": Number(0, 1),
            "moving": Number(0, 1000, whole=True), "points": Number(1, whole=True), "count": Number(1, whole=True),
            "length": Number(0, above=True), "width": size, "height": size,
        }  # fmt: skip
        check_options(self, {name: r for name, r in ranges.items() if getattr(self, name) is not None}, "--")
        check_folder(self.folder, self.overwrite)
        scene = make_scene(self.name, self.seed, self.count, self.width, self.height, self.length)
        if self.panorama:
            if self.height is not None:
                raise ValueError("Panoramas are half as high as wide: leave --height out.")
            scene = replace(scene, cameras=Panoramas.of(scene.cameras))
        make_writable(self.folder, "folder")
        if self.moving:
            scene = with_movers(scene, self.moving)
        cameras, points = scene.cameras, self.points or max(4000, 4 * round(self.length or 0))
        points = 0 if self.panorama else points
        print(f"{self.name}: {len(scene.primitives)} solids, {len(cameras)} cameras; looking for points ...")
        processes = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        sfm = write_dataset(
            scene, self.folder, points, self.noise, self.outliers, self.images, self.overwrite,
            partial(track, description="Rendering"), not self.panorama, make_exposure(self.exposure, scene), processes,
        )  # fmt: skip
        test = int(cameras.is_test.sum())
        kind = "panoramas" if self.panorama else "images with depths" if self.images else "cameras (no images)"
        print(f"Wrote {self.folder}: {len(cameras)} {kind} of {cameras.width}x{cameras.height} pixels,")
        print(f"  {len(cameras) - test} to train with and {test} to test with;")
        if self.panorama:
            print(f"Next: mmpi-prepare {quoted(self.folder / 'images')} scene/")
            return
        print(
            f"  {len(sfm.points)} points in {len(sfm.camera)} keypoints, {int(sfm.outlier.sum())} points wrong,"
            " in colmap/sparse/0 and sparse_pc.ply."
        )
        if len(sfm.points) < points:
            print(f"  The cameras see no more points well enough, and {points} were asked for.")
        if self.images:
            print(f"Next: ns-train mmpi --data {quoted(self.folder)}")


def entrypoint() -> None:
    """The ``mmpi-scene`` command; an error is one sentence and exit status 1."""
    sys.exit(run("mmpi-scene", SceneCommand))


if __name__ == "__main__":
    entrypoint()
