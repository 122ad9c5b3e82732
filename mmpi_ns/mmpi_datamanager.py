"""Pixels on the device, and the training cameras, SfM points and keypoints for the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.model_components.ray_generators import RayGenerator
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.checks import check_transforms, in_one_place
from mmpi_ns.mmpi_dataset import MMPIDataset
from mmpi_ns.placement.observations import Observations
from mmpi_ns.placement.sweep import add_swept_points
from mmpi_ns.random_draws import generator
from mmpi_ns.sfm import SfmModel, find_sfm_model
from mmpi_ns.triangulation import PosedImages, triangulate

OBSERVATIONS = "mmpi_observations"
"""Key under which the model finds the scene's Observations in the data set's metadata."""
RAYS_PER_STEP = "mmpi_rays_per_step"
"""Key under which it finds the pixel rays of a training step."""
MAX_REPROJECTION = 0.02
"""Median angle between keypoints and points, as a share of the image, beyond which a model is in another frame."""
ENOUGH_KEYPOINTS = 20
"""Keypoints an image, on average, that need no plane sweep beside them."""
KEYPOINT_DEPTH = "keypoint_inverse_distance"
"""Ray-bundle metadata: inverse distance of the SfM point on a keypoint ray, 0 on ordinary rays."""


@dataclass
class MMPIDataManagerConfig(VanillaDataManagerConfig):
    """Settings of the data manager."""

    _target: type = field(default_factory=lambda: MMPIDataManager)
    train_num_rays_per_batch: int = 4096
    """Pixel rays a training step."""
    eval_num_rays_per_batch: int = 1024
    """Rays of an evaluation batch during training."""
    keypoint_rays: int = 384
    """Extra rays a step through SfM keypoints of training images, for depth supervision (scenes with tracks only)."""
    sfm_path: Path = Path("colmap/sparse/0")
    """COLMAP model with the tracks, relative to the data, in the frame of transforms.json (colmap parser: its own)."""
    triangulate: bool = True
    """Scenes without tracks: match and triangulate the training images' features at the start (a second or so each)."""
    seed: int = 0
    """Batches depend on this seed and the step alone, so a resumed run draws what an uninterrupted one would."""


@dataclass(frozen=True)
class PixelPool:
    """All training pixels that may be drawn, resident on the device."""

    colors: Tensor
    """[P, C] uint8 or float, C = 3 or 4."""
    indices: Int[Tensor, "P 3"]
    """(image, row, column) of each pixel."""

    @staticmethod
    def from_dataset(dataset: MMPIDataset, device: str | torch.device) -> PixelPool:
        """Reads every image once; masked pixels are left out.

        Raises:
            ValueError: an image or mask cannot be used (names the file), or the masks leave nothing.
        """
        colors, indices = [], []
        for i in range(len(dataset)):
            data = dataset.get_data(i, image_type="uint8")
            image = data["image"]
            keep = torch.ones(image.shape[:2], dtype=torch.bool)
            if "mask" in data:
                keep = data["mask"][..., 0].bool()
            rows, columns = keep.nonzero(as_tuple=True)
            colors.append(image[rows, columns])
            indices.append(torch.stack([torch.full_like(rows, i), rows, columns], -1).to(torch.int32))
        if not sum(len(c) for c in colors):
            raise ValueError("The masks leave no training pixel: white (non-zero) mask pixels are the ones used.")
        return PixelPool(torch.cat(colors).to(device), torch.cat(indices).to(device))

    def draw(self, count: int, g: torch.Generator) -> tuple[Float[Tensor, "R C"], Int[Tensor, "R 3"]]:
        chosen = torch.randint(self.colors.shape[0], (count,), generator=g, device=g.device).to(self.colors.device)
        return self.colors[chosen].float() / 255, self.indices[chosen].long()


def _thumbnail(dataset: MMPIDataset, index: int, side: int = 128) -> NDArray[np.float64]:
    """Gray image of at most ``side`` pixels a side, box-filtered."""
    image = dataset.get_data(index, image_type="uint8")["image"][..., :3].float().mean(-1) / 255
    scale = max(1.0, max(image.shape) / side)
    size = [max(8, round(n / scale)) for n in image.shape]
    return torch.nn.functional.interpolate(image[None, None], size=size, mode="area")[0, 0].double().numpy()


class MMPIDataManager(VanillaDataManager[MMPIDataset]):
    """Draws training batches from a resident pixel pool and hands the scene's observations to the model."""

    config: MMPIDataManagerConfig

    def __init__(self, config: MMPIDataManagerConfig, **kwargs: Any) -> None:
        self.pool: PixelPool | None = None
        parser = config.dataparser
        if isinstance(parser, NerfstudioDataParserConfig):
            check_transforms(
                Path(config.data or parser.data),
                auto_scale=parser.auto_scale_poses,
                opens_first_image=parser.downscale_factor is None and kwargs.get("test_mode") != "inference",
            )
        super().__init__(config, **kwargs)

    def create_train_dataset(self) -> MMPIDataset:
        dataset = super().create_train_dataset()
        observations = read_observations(self.train_dataparser_outputs, dataset.cameras, self._sfm())
        if in_one_place(observations.centers):
            CONSOLE.print("[bold yellow]All training cameras stand in one place: no distance can be learned.")
        if self.test_mode == "val":  # else the plan comes from a checkpoint, and images may be absent
            if not len(observations.seen_by):
                observations = self._find_points(observations, dataset)
            observations = drop_masked(observations, dataset)
        self.observations = observations
        dataset.metadata[RAYS_PER_STEP] = self.config.train_num_rays_per_batch
        dataset.metadata[OBSERVATIONS] = self.observations
        return dataset

    def create_eval_dataset(self) -> MMPIDataset:
        dataset = super().create_eval_dataset()
        if not len(dataset):
            raise ValueError(
                f"No image of {self.config.data} is left for evaluation: give more images, or --eval-mode all after "
                "the name of the data parser."
            )
        return dataset

    def _find_points(self, observations: Observations, dataset: MMPIDataset) -> Observations:
        """Points for a scene without tracks: triangulated, and swept where triangulation finds too few."""
        if self.config.triangulate and (images := posed_images(observations, dataset)) is not None:
            CONSOLE.print(f"No SfM tracks: matching the features of {len(dataset)} training images.")
            observations = with_tracks(observations, triangulate(images))
            CONSOLE.print(f"Triangulated {len(observations.points)} points seen {len(observations.seen_by)} times.")
        if len(observations.seen_by) < ENOUGH_KEYPOINTS * len(dataset):
            CONSOLE.print("Few or no tracks: a quick plane sweep finds out where the content lies.")
            observations = add_swept_points(observations, [_thumbnail(dataset, i) for i in range(len(dataset))])
        return observations

    def _sfm(self) -> SfmModel | None:
        data = Path(self.dataparser.config.data)
        folder = data.parent if data.suffix == ".json" else data
        return find_sfm_model(folder / getattr(self.dataparser.config, "colmap_path", self.config.sfm_path))

    def setup_train(self) -> None:
        """Loads the pixel pool instead of nerfstudio's image cache."""
        CONSOLE.print("Setting up training dataset...")
        self.pool = PixelPool.from_dataset(self.train_dataset, self.device)
        # Samples nothing: ns-export sets its batches' size here.
        self.train_pixel_sampler = self._get_pixel_sampler(self.train_dataset, self.config.train_num_rays_per_batch)
        self.train_ray_generator = RayGenerator(self.train_dataset.cameras.to(self.device))
        self._keypoints = _keypoint_targets(self.observations, self.device)

    def next_train(self, step: int) -> tuple[RayBundle, dict]:
        """Pixel rays first, then keypoint rays (marked in the bundle's metadata), keyed on (seed, step).

        Outside training (ns-export asks for step 0 again and again) pixel rays alone, others with each call.
        """
        self.train_count += 1
        assert self.pool is not None
        g = generator(self.config.seed, step if self.training else self.train_count, "pixels", self.device)
        colors, indices = self.pool.draw(self.get_train_rays_per_batch(), g)
        bundle = self.train_ray_generator(indices)
        depths = torch.zeros(len(bundle), 1, device=self.device)
        if self.training and self._keypoints is not None and self.config.keypoint_rays > 0:
            keypoint_bundle, keypoint_depths = self._keypoint_rays(g)
            bundle, depths = _join(bundle, keypoint_bundle), torch.cat([depths, keypoint_depths])
        bundle.metadata[KEYPOINT_DEPTH] = depths
        return bundle, {"image": colors, "indices": indices}

    def _keypoint_rays(self, g: torch.Generator) -> tuple[RayBundle, Float[Tensor, "Q 1"]]:
        """Rays from training cameras straight at SfM points that they saw, and the inverse distances of those."""
        assert self._keypoints is not None
        cameras, origins, directions, inverse = self._keypoints
        chosen = torch.randint(cameras.shape[0], (self.config.keypoint_rays,), generator=g, device=g.device)
        chosen = chosen.to(cameras.device)
        bundle = RayBundle(
            origins=origins[chosen],
            directions=directions[chosen],
            pixel_area=torch.ones_like(inverse[chosen][:, None]),
            camera_indices=cameras[chosen][:, None],
        )
        return bundle, inverse[chosen][:, None]


def _join(a: RayBundle, b: RayBundle) -> RayBundle:
    assert a.camera_indices is not None and b.camera_indices is not None
    return RayBundle(
        origins=torch.cat([a.origins, b.origins]),
        directions=torch.cat([a.directions, b.directions]),
        pixel_area=torch.cat([a.pixel_area, b.pixel_area]),
        camera_indices=torch.cat([a.camera_indices, b.camera_indices]),
        metadata={},
    )


def _keypoint_targets(observations: Observations, device: str | torch.device) -> tuple[Tensor, ...] | None:
    """Camera, origin, unit direction and inverse distance of every keypoint of the training images.

    The ray goes to the point itself, a fraction of a pixel from the keypoint: no lens model enters.
    """
    tracked = len(observations.seen_at)  # points of a plane sweep come after these: too rough to supervise depth
    if not tracked:
        return None
    origins = observations.centers[observations.seen_by[:tracked]]
    offsets = observations.points[observations.seen_point[:tracked]] - origins
    distance = np.maximum(np.linalg.norm(offsets, axis=-1, keepdims=True), 1e-12)
    parts = (origins, offsets / distance, 1 / distance[:, 0])
    cameras = torch.from_numpy(observations.seen_by[:tracked]).to(device)
    return cameras, *(torch.from_numpy(x).float().to(device) for x in parts)


def read_observations(outputs: DataparserOutputs, cameras: Cameras, sfm: SfmModel | None) -> Observations:
    """Training cameras as they are used, with the SfM points and keypoints moved into their frame.

    Raises:
        ValueError: poses are missing, or poses or intrinsics cannot be used; names the image.
    """
    if not len(outputs.image_filenames):
        raise ValueError("The capture holds no training image: check the split that the data parser made.")
    poses = cameras.camera_to_worlds.double().cpu().numpy()
    flat = [x.double().cpu().numpy().reshape(-1) for x in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)]
    usable = np.isfinite(poses).all((1, 2)) & np.isfinite(flat).all(0) & (flat[0] > 0) & (flat[1] > 0)
    if not usable.all():
        raise ValueError(
            f"The camera of {outputs.image_filenames[usable.argmin()]} has a pose or focal length that is no finite "
            "number or not positive: correct it or remove the frame."
        )
    sizes = np.stack([cameras.width.cpu().numpy().reshape(-1), cameras.height.cpu().numpy().reshape(-1)], -1)
    empty = np.zeros(0, dtype=np.int64)
    result: Mapping[str, Any] = {"points": np.zeros((0, 3)), "seen_by": empty, "seen_point": empty}
    seen_at = np.zeros((0, 2))
    if sfm is not None:
        transform = torch.eye(4, dtype=torch.float64)
        transform[:3] = outputs.dataparser_transform.double()[:3]
        moved = sfm.points @ transform[:3, :3].numpy().T + transform[:3, 3].numpy()
        tracks = sfm.keypoints_of([Path(p).name for p in outputs.image_filenames])
        result = {"points": moved * outputs.dataparser_scale, "seen_by": tracks[0], "seen_point": tracks[1]}
        seen_at = tracks[2] * sizes[tracks[0]]
    elif "points3D_xyz" in outputs.metadata:
        result = {**result, "points": outputs.metadata["points3D_xyz"].double().numpy()}
    observations = Observations(
        camera_to_worlds=poses, intrinsics=np.stack(flat, -1), sizes=sizes.astype(np.float64), seen_at=seen_at, **result
    )
    return _fitting_tracks(observations, cameras) if len(seen_at) else observations


def _fitting_tracks(observations: Observations, cameras: Cameras) -> Observations:
    """Leaves out points behind the camera that saw them, and all tracks where the model is in another frame."""
    angles = keypoint_angles(observations, cameras)
    width = np.arctan(0.5 * observations.sizes[:, 0] / observations.intrinsics[:, 0]) * 2
    if np.median(angles / width[observations.seen_by]) > MAX_REPROJECTION:
        CONSOLE.print(
            "[bold yellow]The COLMAP model does not fit the cameras (its points project elsewhere), so its tracks are "
            "not used: state its frame as applied_transform in transforms.json."
        )
        empty = np.zeros(0, dtype=np.int64)
        return replace(observations, points=np.zeros((0, 3)), seen_by=empty, seen_point=empty, seen_at=np.zeros((0, 2)))
    ahead = angles < np.pi / 2
    if not ahead.all():
        CONSOLE.print(
            f"[bold yellow]{(~ahead).sum()} of {len(ahead)} keypoints have their point behind the camera and are not "
            "used: check the COLMAP model."
        )
    return _keep_keypoints(observations, ahead)


def keypoint_angles(observations: Observations, cameras: Cameras) -> NDArray[np.float64]:
    """Radians [Q] between each keypoint's ray, lens included, and the direction to its point."""
    seen_by = torch.from_numpy(observations.seen_by).to(cameras.device)
    coords = torch.from_numpy(observations.seen_at[:, ::-1].copy()).float().to(cameras.device)
    rays = cameras.generate_rays(camera_indices=seen_by[:, None], coords=coords)
    directions = rays.directions.double().cpu().numpy()
    offsets = observations.points[observations.seen_point] - observations.centers[observations.seen_by]
    across = np.linalg.norm(np.cross(directions, offsets), axis=-1)
    return np.arctan2(across, (directions * offsets).sum(-1))


def _keep_keypoints(observations: Observations, keep: NDArray[np.bool_]) -> Observations:
    return replace(
        observations,
        seen_by=observations.seen_by[keep],
        seen_point=observations.seen_point[keep],
        seen_at=observations.seen_at[keep[: len(observations.seen_at)]],
    )


def posed_images(observations: Observations, dataset: MMPIDataset) -> PosedImages | None:
    """The training images with their cameras and lenses; None where a camera is neither perspective nor fisheye."""
    cameras = dataset.cameras
    types = set(cameras.camera_type.reshape(-1).tolist())
    if types not in ({CameraType.PERSPECTIVE.value}, {CameraType.FISHEYE.value}):
        return None
    fisheye = types == {CameraType.FISHEYE.value}
    lens = cameras.distortion_params  # k1, k2, k3, k4, p1, p2
    lens = torch.zeros(len(dataset), 6) if lens is None else lens.reshape(len(dataset), 6).cpu()
    used = [0, 1, 2, 3] if fisheye else [0, 1, 4, 5]
    return PosedImages(
        files=tuple(Path(name) for name in dataset.image_filenames),
        camera_to_worlds=observations.camera_to_worlds,
        intrinsics=observations.intrinsics,
        sizes=observations.sizes,
        distortion=lens[:, used].double().numpy(),
        fisheye=fisheye,
    )


def with_tracks(observations: Observations, model: SfmModel) -> Observations:
    """The observations with the points of a model whose image names are the places of the training images."""
    seen_by, seen_point, relative = model.keypoints_of([str(i) for i in range(len(observations.centers))])
    return replace(
        observations,
        points=model.points,
        seen_by=seen_by,
        seen_point=seen_point,
        seen_at=relative * observations.sizes[seen_by],
    )


def drop_masked(observations: Observations, dataset: MMPIDataset) -> Observations:
    """Leaves out keypoints on masked pixels: what moves there has no depth to learn from."""
    if not len(observations.seen_at) or dataset._dataparser_outputs.mask_filenames is None:
        return observations
    keep = np.ones(len(observations.seen_by), dtype=bool)
    for i in range(len(dataset)):
        mask = dataset.get_data(i, image_type="uint8")["mask"][..., 0].numpy().astype(bool)
        own = np.nonzero(observations.seen_by[: len(observations.seen_at)] == i)[0]
        x, y = observations.seen_at[own].astype(int).T
        keep[own] = mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)]
    return _keep_keypoints(observations, keep)
