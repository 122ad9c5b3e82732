"""Trained scenes as functions: ``load`` a run, ``render`` images from any pinhole cameras.

``mmpi_show.load`` reads baked scenes. Neither needs the images of the capture or nerfstudio's classes. Examples:
docs/export.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import yaml
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.trainer import TrainerConfig
from torch import Tensor

from mmpi_ns.settings import MMPIModelConfig
from mmpi_ns.training.checkpoints import last_checkpoint, read_checkpoint
from mmpi_ns.utils.errors import InputError, brief
from mmpi_ns.utils.parallel import torch_apart


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Cameras of the capture that a scene was trained on."""

    camera_to_worlds: Float[Tensor, "N 3 4"]
    """Camera axes are x right, y up, looking along -z; world axes and units are those of the scene."""
    intrinsics: Float[Tensor, "N 3 3"]
    """Pixels; pixel centres lie at halves."""
    sizes: Int[Tensor, "N 2"]
    """Width and height, pixels."""

    @staticmethod
    def of(rows: Float[Tensor, "N 18"]) -> CameraPath:
        """The path of rows with a pose [3, 4], focal lengths, principal point, width and height."""
        intrinsics = torch.eye(3).repeat(len(rows), 1, 1)
        intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]] = rows[:, 12:16]
        return CameraPath(rows[:, :12].view(-1, 3, 4), intrinsics, rows[:, 16:].long())

    def __len__(self) -> int:
        return len(self.sizes)


@dataclass(frozen=True, eq=False)
class Scene:
    """A trained scene, ready to render."""

    mpis: tuple[str, ...]
    """Names of the MPIs and cubes that ``Images.winning_mpi`` numbers."""
    path: CameraPath
    """Training cameras of a run; training and test cameras of a baked scene, in the order of the capture."""
    device: torch.device
    """Where images are rendered. Baked scenes are rendered on the CPU and their images moved here."""
    _render: Callable[[Cameras], dict[str, Tensor]]
    """Outputs [H, W, C] of one camera."""


@dataclass(frozen=True, eq=False)
class Images:
    """Rendered images; the leading axes are those of the cameras."""

    rgb: Float[Tensor, "*N H W 3"]
    """Colours in [0, 1] over the scene's background."""
    depth: Float[Tensor, "*N H W 1"]
    """Median distance from the camera along the ray, scene units."""
    accumulation: Float[Tensor, "*N H W 1"]
    """Opacity of the scene along the ray, in [0, 1]."""
    winning_mpi: Int[Tensor, "*N H W 1"]
    """Number in ``Scene.mpis`` of the MPI with the largest weight on the ray."""


def load(path: str | Path, device: str | torch.device | None = None) -> Scene:
    """A run of ns-train at its last checkpoint, rendered exactly as by ns-eval, without the images of the capture.

    Args:
        path: a run's folder or its config.yml.
        device: where images are rendered; by default a GPU if there is one.

    Raises:
        InputError: there is no run, or its files are damaged; the message names the file and the remedy.
    """
    path = Path(path)
    device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    folder = path.parent if path.is_file() else path
    if not (folder / "config.yml").is_file():
        raise InputError(
            f"There is no run at {path}: give its folder, with config.yml. Scenes that mmpi-export bake or mmpi-export "
            "web wrote are read by mmpi_show.load."
        )
    # The model with its last checkpoint, without a data manager.
    config = read_run_config(folder / "config.yml")
    state = read_checkpoint(last_checkpoint(folder / "nerfstudio_models"))
    cameras = state["capture"]["cameras"]
    config.windows_folder = folder / "windows"
    unbounded = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model = config.setup(scene_box=unbounded, num_train_data=len(cameras), metadata={}, device=device).to(device)
    tensors = {k.removeprefix("_model."): v for k, v in state["pipeline"].items() if k.startswith("_model.")}
    model.load_state_dict(tensors)
    model.update_to_step(state["step"])
    model.eval()
    return Scene(model.progress.windows.names, CameraPath.of(cameras), device, model.get_outputs_for_camera)


def read_run_config(path: Path) -> MMPIModelConfig:
    """The model's settings in a run's config.yml. Raises InputError if ns-train did not write it, or if it is of
    another method or an incompatible version."""
    try:
        config = yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a config.yml that ns-train wrote ({brief(error)}).") from error
    if not isinstance(config, TrainerConfig):
        raise InputError(f"{path} is not a config.yml that ns-train wrote: give the one beside nerfstudio_models.")
    if not isinstance(config.pipeline.model, MMPIModelConfig):
        raise InputError(f"The run of {path} was trained by another method: only those of mmpi can be read.")
    return config.pipeline.model


@torch_apart()
@torch.no_grad()
def render(
    scene: Scene,
    camera_to_worlds: Float[Tensor, "*N 3 4"] | Float[Tensor, "*N 4 4"],
    intrinsics: Float[Tensor, "*N 3 3"] | Float[Tensor, "3 3"],
    width: int,
    height: int,
) -> Images:
    """Images of a scene from pinhole cameras, without gradients.

    Args:
        scene: from ``load``.
        camera_to_worlds: poses of the cameras: x right, y up, looking along -z; world axes and units of the scene,
            which ``dataparser_transforms.json`` beside config.yml relates to those of the capture. [*N, 3 or 4, 4]
        intrinsics: focal lengths and principal point in pixels, without skew; pixel centres lie at halves.
            [*N, 3, 3], or [3, 3] for all cameras
        width: of the images, pixels.
        height: of the images, pixels.

    Returns:
        Images [*N, H, W, .] on the scene's device; [H, W, .] for one pose [3, 4].

    Raises:
        InputError: a shape is wrong, or intrinsics have a skew.
    """
    poses, lenses = (torch.as_tensor(x, dtype=torch.float32).cpu() for x in (camera_to_worlds, intrinsics))
    if poses.shape[-2:] not in ((3, 4), (4, 4)) or not poses.numel():
        raise InputError(f"camera_to_worlds must be [*N, 3, 4] or [*N, 4, 4], not {list(poses.shape)}.")
    batch = poses.shape[:-2]
    if lenses.shape not in ((3, 3), (*batch, 3, 3)):
        raise InputError(f"intrinsics must be [3, 3] or {[*batch, 3, 3]}, not {list(lenses.shape)}.")
    poses, lenses = poses.reshape(-1, *poses.shape[-2:])[:, :3], lenses.expand(*batch, 3, 3).reshape(-1, 3, 3)
    if bool(lenses[:, [0, 1], [1, 0]].any()):
        raise InputError("Cameras are rendered without skew, and these intrinsics have one.")
    fx, fy, cx, cy = (lenses[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    cameras = Cameras(poses, fx, fy, cx, cy, width, height)
    outputs = [scene._render(cameras[i : i + 1].to(scene.device)) for i in range(len(poses))]
    rgb, depth, accumulation, winner = (
        torch.stack([image[name] for image in outputs]).to(scene.device).view(*batch, height, width, -1)
        for name in ("rgb", "depth", "accumulation", "winning_mpi")
    )
    return Images(rgb, depth, accumulation, winner.long())
