"""The observations of a scene outside training, as ``ns-train`` would pass them to placement."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils.rich_utils import CONSOLE

from mmpi_ns.capture.checks import check_transforms
from mmpi_ns.capture.datamanager import OBSERVATIONS, MMPIDataManagerConfig
from mmpi_ns.capture.dataset import MMPIDataset, take_local_origins
from mmpi_ns.capture.moving_picture import draw_moving
from mmpi_ns.capture.observe import observe, sfm_folder
from mmpi_ns.placement.observations import Observations
from mmpi_ns.utils.errors import InputError

Parser = Literal["auto", "nerfstudio", "colmap"]


def check_there(data: Path) -> None:
    """Raises InputError where there is neither a folder nor a file."""
    if not data.exists():
        raise InputError(f"There is no scene at {data}: check the path.")


def load_observations(
    data: Path, downscale_factor: int | None = None, parser: Parser = "auto", moving: Path | None = None
) -> tuple[Observations, str]:
    """The observations that training on a scene would use, and a sentence on what moves in its images.

    Args:
        data: the scene's folder.
        downscale_factor: size of the images, as for the data parser; None leaves it to the parser.
        parser: format of the scene; auto means nerfstudio's format if there is a transforms.json.
        moving: file for a picture of what moves. None: neither movers nor depths of pixels are searched, which takes
            minutes; tracks or a plane sweep take their place.

    Raises:
        InputError: the folder holds no scene, or one that cannot be trained.
    """
    check_there(data)
    config = MMPIDataManagerConfig(dataparser=NerfstudioDataParserConfig(load_3D_points=True))
    is_nerfstudio = data.suffix == ".json" or (data / "transforms.json").is_file()
    if parser == "colmap" or (parser == "auto" and not is_nerfstudio):
        model = next((p for p in ("colmap/sparse/0", "sparse/0", "sparse") if (data / p).is_dir()), None)
        if model is None:
            raise InputError(f"{data} holds neither a transforms.json nor a COLMAP model: it is not a scene.")
        config.dataparser = ColmapDataParserConfig(colmap_path=Path(model))
        config.sfm_path = Path(model)
    parser_config = config.dataparser
    config.data = parser_config.data = data
    parser_config.downscale_factor = downscale_factor  # type: ignore[attr-defined]
    if isinstance(parser_config, NerfstudioDataParserConfig):
        check_transforms(parser_config, data, ("train",), opens=True)
    take_local_origins(parser_config)
    outputs = parser_config.setup().get_dataparser_outputs(split="train")
    if any(Path(name).is_file() for name in outputs.image_filenames):
        # As ns-train does, so that it refuses what ns-train would refuse, and finds the depths that it would find.
        config.mask_moving = config.dense_depth = config.depth_images = moving is not None
        config.new_view_share, config.correct_exposure = 0.0, False  # placement asks for neither
        manager = config.setup(device="cpu", test_mode="val")
        masks = manager.train_dataset.moving
        if moving is not None and masks is not None:
            names = [Path(name).name for name in outputs.image_filenames]
            colors = (manager.train_dataset.get_data(i, "uint8")["image"][..., :3] for i in range(len(names)))
            draw_moving(moving, zip(names, (np.flip(x.numpy(), -1) for x in colors), strict=True), masks)
        return manager.train_dataset.metadata[OBSERVATIONS], manager.moves
    CONSOLE.print(f"The images of {data} are not there: its cameras and points alone are judged.")
    folder = sfm_folder(parser_config, config.sfm_path)
    return observe(outputs, MMPIDataset(outputs), folder, find_points=True, triangulates=config.triangulate), ""
