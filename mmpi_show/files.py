"""Baked scenes on disk: a header ``scene.json`` and one file of arrays for each window (format: docs/export.md)."""

from __future__ import annotations

import gzip
import json
import math
import zlib
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.data.rays import image_rays
from mmpi_ns.functional import CameraPath, Scene
from mmpi_ns.rendering.details import Details, DetailView
from mmpi_ns.rendering.images import FUSED_RAYS, render_in_chunks, render_windows
from mmpi_ns.scene.bricks import bits_of
from mmpi_ns.scene.plan import MPIPlan, ScenePlan
from mmpi_ns.scene.windows import Window, WindowedPlan, window_shares
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.files import write_atomically
from mmpi_ns.utils.parallel import in_order, torch_apart
from mmpi_show import reader
from mmpi_show.codes import coarse_differences, split_codes
from mmpi_show.details import STEP, StoredView, restored_view
from mmpi_show.scene import SIDE, BakedMpis, Codes, Shader
from mmpi_show.windows import BakedWindow

FORMAT, VERSION = "mmpi-baked", 5
HEADER = "scene.json"
EARLY = 0.1
"""Share of a window's bytes for its first part: coarse texels of the bricks with the largest weights in training
views."""
PARTS_OF_VIEW = ("difference", "inverse")
NUMBERS = ("ray_near", "threshold", "background", "farthest")
"""Of a window, under their names in the header."""


@dataclass(frozen=True)
class Pose:
    """A camera of the captured path."""

    to_world: list[list[float]]
    """Rows of the 3 x 4 matrix from camera axes (x right, y up, looking along -z) to the world's."""
    size: tuple[int, int]
    """Width and height, pixels."""
    focal: tuple[float, float]
    """Pixels."""
    center: tuple[float, float]
    """Pixels."""
    test: bool = False
    """Held out from training."""

    def rays(self) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
        """Origins and unit directions through the centres of all pixels, row by row."""
        camera = Cameras(torch.tensor(self.to_world, dtype=torch.float32)[None], *self.focal, *self.center, *self.size)
        bundle = image_rays(camera).flatten()
        return bundle.origins.contiguous(), bundle.directions.contiguous()


@dataclass(frozen=True)
class BakedScene:
    """All windows of a run, the camera path, and the up direction."""

    name: str
    up: tuple[float, float, float]
    path: list[Pose]
    windows: list[tuple[Window, BakedWindow]]
    """The region of a window (its plan contains the MPIs as baked), and its content."""
    views: tuple[StoredView, ...] = ()
    """Details of the training images (docs/details.md)."""
    nearest: int = 0
    """Number of training images whose details are added to an image."""

    @cached_property
    def details(self) -> Details:
        """Details of the training images. Raises ValueError when a damaged one is needed."""

        def read(i: int, device: torch.device) -> DetailView:
            try:
                return restored_view(self.views[i], device)
            except (OSError, ValueError, SyntaxError) as error:
                raise ValueError(
                    f"Details of training image {i} are damaged ({error}): bake the scene again."
                ) from error

        return Details(torch.tensor([view.camera for view in self.views]), read)

    @torch_apart()
    def image(self, bundle: RayBundle) -> dict[str, Tensor]:
        """Outputs of an image's rays [H, W], as those of the model, with details if there are any."""
        device = bundle.origins.device
        outputs = render_in_chunks(bundle, FUSED_RAYS, device, lambda rays: self.render(rays.origins, rays.directions))
        if not self.views:
            return outputs
        exposure = outputs["rgb"].new_tensor(self.windows[0][1].exposure)
        outputs["radiance"] = outputs["rgb"] / exposure
        return self.details.added(outputs, bundle, self.nearest, exposure)

    def render(self, origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]) -> dict[str, Tensor]:
        """The field's outputs for rays, as ``BakedWindow.render``, of the windows that they start in, mixed as in the
        model."""
        places, windows = zip(*self.windows, strict=True)

        def render(w: int, rays: Tensor) -> dict[str, Tensor]:
            outputs = windows[w].render(origins[rays], directions[rays])
            outputs["winning_mpi"] += sum(len(window.mpis.mpis) for window in windows[:w])
            return outputs

        return render_windows(origins, places, render)


def write_baked(scene: BakedScene, folder: Path) -> int:
    """Writes a scene into a folder in place of an earlier one, the header last: a scene with a header is complete.

    Returns:
        Bytes that were written.

    Raises:
        OSError: the disk is full or cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for old in (folder / HEADER, *folder.glob("window-*.bin"), *folder.glob(".*.tmp")):  # of an earlier export
        old.unlink(missing_ok=True)
    # Details of training images are kept with the window that they stand nearest to.
    views: list[list[StoredView]] = [[] for _ in scene.windows]
    if scene.views:
        centers = torch.tensor([view.camera for view in scene.views])[:, [3, 7, 11]]
        shares = window_shares(centers, tuple(place for place, _ in scene.windows))
        for view, number in zip(scene.views, shares.argmax(-1).tolist(), strict=True):
            views[number].append(view)
    rows = [_write_window(folder / f"window-{i:05d}.bin", *window, views[i]) for i, window in enumerate(scene.windows)]
    header = {
        "format": FORMAT,
        "version": VERSION,
        "name": scene.name,
        "up": scene.up,
        "path": [pose.__dict__ for pose in scene.path],
        "details": {"nearest": scene.nearest, "step": STEP} if scene.views else None,
        "windows": rows,
    }
    text = json.dumps(header, allow_nan=False)
    write_atomically(folder / HEADER, lambda path: path.write_text(text, encoding="utf-8"))
    return sum(row["bytes"] for row in rows) + len(text)


def _write_window(file: Path, place: Window, window: BakedWindow, views: list[StoredView]) -> dict[str, Any]:
    """Writes a window's arrays one after the other, each compressed, and then details; returns the window's part of the
    header."""
    mpis, shader = window.mpis, window.shader
    blob, places = b"", {}
    for name, array in _arrays(window, sum(len(view.difference + view.inverse) for view in views)).items():
        data = _gzip(array)
        places[name] = {"type": str(array.dtype), "shape": array.shape, "offset": len(blob), "bytes": len(data)}
        blob += data
    bricks_bytes, view_rows = len(blob), []
    for view in views:
        row: dict[str, Any] = {"camera": view.camera, "size": view.size, "most": view.most}
        for name in PARTS_OF_VIEW:
            row[name] = {"offset": len(blob), "bytes": len(getattr(view, name))}
            blob += getattr(view, name)
        view_rows.append(row)
    write_atomically(file, lambda path: path.write_bytes(blob))
    plan = json.loads(place.plan.to_json())
    extra = [{"interval": interval, "first_column": mpis.first_column(k)} for k, interval in enumerate(mpis.intervals)]
    return {
        "file": file.name,
        "bytes": len(blob),
        "first_bytes": places["columns"]["offset"],
        "bricks_bytes": bricks_bytes,
        "center": place.center,
        "radius": None if math.isinf(place.radius) else place.radius,
        "margin": place.margin,
        **{name: getattr(window, name) for name in (*NUMBERS, "exposure")},
        "content_near": place.plan.content_near,
        "mpis": [m | e for m, e in zip(plan["mpis"], extra, strict=True)],
        "density": mpis.density_codes.__dict__,
        "channels": [c.__dict__ for c in mpis.channel_codes],
        "shader": {
            "inputs": ["colour", "features", "direction"],
            "direction_octaves": shader.direction_octaves,
            "layers": [list(weights.shape) for weights, _ in shader.layers],
            "bound": shader.bound,
        },
        "arrays": places,
        "views": view_rows,
    }


def _arrays(window: BakedWindow, behind: int) -> dict[str, NDArray[Any]]:
    """Arrays of a window in the order of its file, which ``behind`` bytes of details follow."""
    mpis = window.mpis
    beside = mpis.neighbours()
    channels = [mpis.density, *mpis.texels.unbind(-1)]
    coarse, fine = map(np.stack, zip(*in_order(lambda channel: split_codes(channel, beside), channels), strict=True))
    network = [x.detach().half().reshape(-1) for layer in window.shader.layers for x in layer]
    others = {
        "network": torch.cat(network).numpy(),
        "columns": mpis.columns[:, 0].numpy().view(np.uint32),
    }
    beside_bricks = sum(len(_gzip(array)) for array in others.values())  # the first part has columns too
    room = EARLY * (len(_gzip(coarse_differences(coarse))) + len(_gzip(fine)) + beside_bricks + behind) - beside_bricks
    # The bricks whose coarse codes come first: those with the largest weights in training views, as many as fit.
    count = mpis.num_bricks
    order = torch.arange(count) if window.seen is None else window.seen.argsort(descending=True, stable=True)
    thousandth = torch.empty_like(order).index_copy(0, order, 1000 * torch.arange(count) // max(count, 1))
    early = thousandth < bisect_right(
        range(1, 1000), room, key=lambda n: len(_gzip(coarse_differences(coarse[:, (thousandth < n).numpy()])))
    )
    return {
        "early_columns": window.keep(early).mpis.columns[:, 0].numpy().view(np.uint32),
        "early": coarse_differences(coarse[:, early.numpy()]),
        **others,
        "late": coarse_differences(coarse[:, ~early.numpy()]),
        "fine": fine,
    }


def _gzip(array: NDArray[Any]) -> bytes:
    """A gzip file, without a name or a time."""
    # Runs and frequent bytes alone: of differences that are mostly 0, other repetitions cost more than they save.
    packer = zlib.compressobj(6, zlib.DEFLATED, 31, 9, zlib.Z_RLE)
    return packer.compress(np.ascontiguousarray(array).tobytes()) + packer.flush()


def read_baked(folder: Path) -> BakedScene:
    """A scene that ``write_baked`` wrote.

    Raises:
        InputError: there is none.
        ValueError: it is damaged or of another version; the message says which file, and the remedy.
    """
    path = folder / HEADER
    if not path.is_file():
        raise InputError(
            f"There is no baked scene at {folder}: give a folder that mmpi-export bake or mmpi-export web wrote (with "
            f"{HEADER}). Runs are read by mmpi_ns.load."
        )
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
        if header["format"] != FORMAT:
            raise ValueError(f"{path} is not the header of a baked scene: give the folder that mmpi-export bake wrote.")
        if header["version"] != VERSION:
            raise ValueError(
                f"{path} is of version {header['version']}, and this program reads version {VERSION}: use the program "
                "that wrote it, or bake the scene again."
            )
        windows, views = zip(*(_read_window(folder, row) for row in header["windows"]), strict=True)
        nearest = 0 if header["details"] is None else header["details"]["nearest"]
        vectors = ("size", "focal", "center")
        cameras = [Pose(p["to_world"], *(tuple(p[v]) for v in vectors), test=p["test"]) for p in header["path"]]
        return BakedScene(header["name"], tuple(header["up"]), cameras, list(windows), sum(views, ()), nearest)
    except (KeyError, TypeError, InputError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is damaged ({error!r}): bake the scene again.") from error


def load(path: str | Path, device: str | torch.device = "cpu") -> Scene:
    """A scene written by ``mmpi-export bake`` or ``mmpi-export web``; speed and loss of quality: docs/export.md.

    Args:
        path: the folder.
        device: where images are moved; they are rendered on the CPU.

    Raises:
        InputError, ValueError: as ``read_baked``.
    """
    baked = read_baked(Path(path))
    cameras = torch.tensor([[*chain(*pose.to_world), *pose.focal, *pose.center, *pose.size] for pose in baked.path])
    names = WindowedPlan(tuple(place for place, _ in baked.windows)).names
    return Scene(
        names, CameraPath.of(cameras), torch.device(device), lambda camera: baked.image(image_rays(camera.to("cpu")))
    )


def _read_window(folder: Path, row: dict[str, Any]) -> tuple[tuple[Window, BakedWindow], tuple[StoredView, ...]]:
    path = folder / row["file"]
    blob = path.read_bytes() if path.is_file() else b""
    if len(blob) != row["bytes"]:
        raise ValueError(
            f"{path} is cut short or missing ({len(blob)} of {row['bytes']} bytes): copy it anew, or bake again."
        )

    def part(spec: dict[str, int]) -> bytes:
        return blob[spec["offset"] : spec["offset"] + spec["bytes"]]

    arrays: dict[str, NDArray[Any]] = {}
    for name, spec in row["arrays"].items():
        try:
            data = gzip.decompress(part(spec))
            arrays[name] = np.frombuffer(data, spec["type"]).reshape(spec["shape"]).copy()
        except (OSError, EOFError, ValueError) as error:
            raise ValueError(
                f"{path} is damaged ('{name}': {error}): copy it anew, or bake the scene again."
            ) from error
    views = tuple(
        StoredView(tuple(view["camera"]), tuple(view["size"]), view["most"], *(part(view[x]) for x in PARTS_OF_VIEW))
        for view in row["views"]
    )
    mpi_rows = [{name: m[name] for name in MPIPlan.__dataclass_fields__} for m in row["mpis"]]
    nears = {"ray_near": row["ray_near"], "content_near": row["content_near"]}
    plan = ScenePlan.from_object({"mpis": mpi_rows, "cube": None, "origin_of_plan": "baked", **nears})
    radius = math.inf if row["radius"] is None else row["radius"]
    masks, early_masks = (torch.from_numpy(arrays[name].view(np.int32)) for name in ("columns", "early_columns"))
    early = bits_of(early_masks)[bits_of(masks) > 0] > 0
    decoded = row | {f"{name}_array": array for name, array in arrays.items()}
    codes = torch.from_numpy(reader.decode(decoded)).view(-1, len(early), SIDE, SIDE)
    columns = torch.from_numpy(decoded["columns_array"].astype(np.int32))
    intervals, channels = tuple(m["interval"] for m in row["mpis"]), tuple(Codes(**c) for c in row["channels"])
    tables = columns, codes[0], codes[1:].movedim(0, -1).contiguous()
    baked = BakedMpis(plan.mpis, intervals, *tables, Codes(**row["density"]), channels)
    shapes = row["shader"]["layers"]
    parts = torch.from_numpy(arrays["network"]).float().split([n for o, i in shapes for n in (o * i, o)])
    layers = tuple((weights.view(s), b) for s, weights, b in zip(shapes, parts[::2], parts[1::2], strict=True))
    shader = Shader(layers, row["shader"]["direction_octaves"], row["shader"]["bound"])
    numbers = {name: row[name] for name in NUMBERS}
    baked_window = BakedWindow(baked, shader, **numbers, exposure=tuple(row["exposure"]), seen=early.float())
    return (Window(tuple(row["center"]), radius, row["margin"], plan), baked_window), views
