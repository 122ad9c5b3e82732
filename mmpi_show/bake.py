"""Baking of a finished run: all windows, with the bricks that training views see, and the camera path."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.eval_utils import eval_setup
from torch import Tensor

from mmpi_ns.data.rays import image_rays
from mmpi_ns.functional import read_run_config
from mmpi_ns.model import MMPIModel
from mmpi_ns.rendering.metrics import ImageMetrics, psnr
from mmpi_ns.scene.windows import window_shares
from mmpi_ns.utils.files import natural_key
from mmpi_ns.utils.parallel import in_order, torch_apart
from mmpi_show.codes import smoothed_codes
from mmpi_show.details import stored_view
from mmpi_show.files import BakedScene, Pose
from mmpi_show.scene import most_of_copies
from mmpi_show.windows import BakedWindow, bake

SLACK = 0.01
"""Maximum error of a texel's colours and features (before sigmoid and tanh), times its largest weight in a training
view: for a colour, at most 0.0025 of a pixel's."""
MOST_LOOKED_AT = 60e6
"""Maximum number of training pixels of a window that decide which bricks are visible; of more, every n-th row and
column is used."""


def load_model(load_config: Path, details: bool = False) -> Any:
    """The pipeline of a finished run, ready to render exactly: with details of its training images, or its field alone.
    Raises InputError as ``read_run_config``."""
    read_run_config(load_config)
    _, pipeline, _, _ = eval_setup(load_config, test_mode="test")
    assert isinstance(pipeline.model, MMPIModel)
    if not details:
        pipeline.model.details = None
    return pipeline


@torch_apart()
def bake_run(pipeline: Any, least: float) -> BakedScene:
    """All windows of a finished run, baked, and the details that its model has.

    Args:
        pipeline: of the run.
        least: bricks without a sample of this weight in any training view are dropped; 0 keeps all.

    Raises:
        ValueError: the model cannot be baked; the message says why.
    """
    model: MMPIModel = pipeline.model
    cameras: Cameras = pipeline.datamanager.train_dataset.cameras
    places = model.progress.windows.windows
    shares = window_shares(cameras.camera_to_worlds[:, :, 3], places)
    views, nearest = (), 0
    if (details := model.details) is not None:
        read, nearest = details.view, model.config.rendering.nearest_images
        views = tuple(in_order(lambda i: stored_view(read(i, torch.device("cpu"))), range(len(details.cameras))))
        written = sum(len(v.difference + v.inverse) for v in views)
        print(f"Details of {len(views)} training images: {written / 1e6:.2f} MB.")
    windows = []
    for number, place in enumerate(places):
        field = model.field if number == model.progress.window else model.store.load(number, model.device)
        whole = bake(model, field)
        cameras_here = (shares[:, number] > 0).nonzero()[:, 0].tolist()
        step = math.ceil((float((cameras.width * cameras.height)[cameras_here].sum()) / MOST_LOOKED_AT) ** 0.5)
        alike = sorted(cameras_here, key=lambda i: [float(x[i]) for x in (cameras.width, cameras.height, cameras.fx)])
        rays = (image_rays(cameras[i : i + 1], step).flatten() for i in alike)
        peaks = whole.peaks((each.origins, each.directions) for each in rays)
        seen = peaks.amax((1, 2)) >= least
        kept = smoothed(replace(whole, seen=peaks.sum((1, 2))).keep(seen), peaks[seen])
        print(f"Window {number}: {kept.mpis.num_bricks} of {whole.mpis.num_bricks} bricks are seen.")
        windows.append((replace(place, plan=replace(place.plan, mpis=kept.mpis.mpis, cube=None)), kept))
    poses = {}  # of all cameras, training and test, by image name; those of both are training cameras
    for dataset, test in ((pipeline.datamanager.eval_dataset, True), (pipeline.datamanager.train_dataset, False)):
        for i, image in enumerate(dataset.image_filenames):
            camera = dataset.cameras[i]
            focal, center = (float(camera.fx), float(camera.fy)), (float(camera.cx), float(camera.cy))
            size = (int(camera.width), int(camera.height))
            poses[str(image)] = Pose(camera.camera_to_worlds.tolist(), size, focal, center, test)
    path = [poses[image] for image in sorted(poses, key=natural_key)]
    ups = torch.tensor([pose.to_world for pose in path])[:, :, 1].mean(0)
    name = Path(pipeline.datamanager.get_datapath()).resolve().name
    return BakedScene(name, tuple((ups / ups.norm()).tolist()), path, windows, views, nearest)


def smoothed(window: BakedWindow, peaks: Float[Tensor, "B 8 8"]) -> BakedWindow:
    """The window with colours and features that take fewer bytes where their weights in training views are small.
    Densities are not changed: their errors are visible before bytes are saved.

    Args:
        window: as baked.
        peaks: largest weights of its texels in training views.
    """
    mpis = window.mpis
    beside = mpis.neighbours()
    most = most_of_copies(peaks, beside)
    slacks = [(SLACK / codes.step / most).clamp(max=255).to(torch.uint8) for codes in mpis.channel_codes]
    channels = zip(mpis.texels.unbind(-1), slacks, strict=True)
    texels = list(in_order(lambda channel: smoothed_codes(*channel, beside), channels))
    return replace(window, mpis=replace(mpis, texels=torch.stack(texels, -1), packed={}))


@torch.no_grad()
def compare(pipeline: Any, scene: BakedScene, count: int) -> dict[str, dict[str, float]]:
    """Baked test images beside exact ones: means over the images.

    Args:
        pipeline: of the run.
        scene: its baked scene.
        count: number of test images, evenly spaced; all if there are fewer.

    Returns:
        For the renderers "exact" and "baked": psnr and ssim against the ground truth, processor seconds per frame, and
        "to_exact", the PSNR against the exact renderer's images, dB.
    """
    dataset, metrics = pipeline.datamanager.eval_dataset, ImageMetrics("none")
    rows: dict[str, list[dict[str, float]]] = {"exact": [], "baked": []}
    for i in torch.linspace(0, len(dataset) - 1, min(count, len(dataset))).long().tolist():
        bundle, truth = image_rays(dataset.cameras[i : i + 1]), pipeline.model.observed(dataset[i]).cpu()
        exact = None
        for name, image_of in (("exact", pipeline.model.get_outputs_for_camera_ray_bundle), ("baked", scene.image)):
            start = time.process_time()
            image = image_of(bundle)["rgb"].cpu()
            seconds = time.process_time() - start
            exact = image if exact is None else exact
            row = {"ssim": math.nan, "seconds": seconds, "to_exact": psnr(image, exact)}
            rows[name].append(row | metrics(image, truth))
    return {name: {key: fmean(r[key] for r in each) for key in each[0]} for name, each in rows.items()}
