"""What refined poses bring, with poses as they are and disturbed on purpose."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from lab import SceneBench, train_and_evaluate
from nerfstudio.cameras.lie_groups import exp_map_SO3xR3
from numpy.typing import NDArray
from plane_crossings import images_of
from refined import refined_camera
from report import Report, Row, page, table
from trainers import Scene

from mmpi_ns.rendering.metrics import psnr_and_ssim
from mmpi_ns.scripts.command import run
from mmpi_prepare.adjustment import degrees_between
from mmpi_show.bake import load_model

Array = NDArray[np.float64]
MODES = {"as they are": "off", "refined in training": "SO3xR3"}


@dataclass
class Poses(SceneBench):
    """Trains mmpi-small with and without refined poses, as a user would, and scores test images twice.

    Training poses are taken as they are, and with errors of a known size: test poses stay. Tracks and depths are found
    anew under the poses that are given.
    """

    degrees: float = 0.3
    """Error of each disturbed training pose's rotation, about a random axis; 0 disturbs none."""
    distance: float = 0.05
    """Error of its position in a random direction, in units of the capture."""
    steps: int = 750
    """Of each training."""
    test_images: int = 14
    """Test images that are scored, evenly spaced; 0 for all."""

    name = "poses"

    def run(self) -> None:
        report = Report(self, key=self.key(), file=f"poses-{self.scene.name}")
        for given in ("given", "disturbed") if self.degrees or self.distance else ("given",):
            for poses, mode in MODES.items():
                name = f"{given} poses, {poses}"
                row = report.row(name, lambda given=given, mode=mode: self._row(given, mode))
                print(json.dumps({name: row}), flush=True)
        report.finish({}, markdown(report.content))

    def _row(self, given: str, mode: str) -> Row:
        folder = self.folder / self.scene.name / f"{given}-{mode}"
        exact, scene = folder / "exact", folder / "scene"
        off = (self.degrees, self.distance) if given == "disturbed" else (0.0, 0.0)
        write_scene(self.data.resolve(), exact, self.test_images)
        write_scene(self.data.resolve(), scene, self.test_images, *off)
        options = ["--pipeline.model.camera-optimizer.mode", mode]
        options += ["--max-num-iterations", str(self.steps), "--pipeline.model.lpips-net", "none"]
        copied = Scene(scene, self.downscale_factor)
        run, results, made = train_and_evaluate(copied, folder, "mmpi-small", options, (), self.cores)
        scores = {name: results[name] for name in ("psnr", "ssim")} | refined_scores(run)
        return scores | made | pose_errors(exact, scene, run)


def refined_scores(run: Path) -> Row:
    """Means over the test images of a run, each at the pose from which its frozen model renders it best."""
    pipeline, rows = load_model(run / "config.yml"), []
    for i, (camera, image) in enumerate(images_of(pipeline)):
        moved_camera, degrees, _ = refined_camera(pipeline, camera, image, i)
        outputs = pipeline.as_exposed(moved_camera, pipeline.model.get_outputs_for_camera(moved_camera), image)
        rows.append(psnr_and_ssim(outputs["rgb"], image) | {"rotation_degrees": degrees})
    return {f"refined_{name}": float(np.mean([row[name] for row in rows])) for name in rows[0]}


def write_scene(data: Path, folder: Path, test_images: int, degrees: float = 0.0, distance: float = 0.0) -> Path:
    """A copy of a scene without tracks, whose images are links, with so many test images (0: all), evenly spaced, and
    errors of so many degrees and units in its training poses."""
    folder.mkdir(parents=True, exist_ok=True)
    meta, rng = json.loads((data / "transforms.json").read_text(encoding="utf-8")), np.random.default_rng(0)
    named = {Path(told).parts[0] for f in meta["frames"] for told in f.values() if isinstance(told, str)}
    for path in data.iterdir():  # images, masks, depths, and their smaller copies
        if path.is_dir() and path.name.startswith(tuple(named)) and not (folder / path.name).exists():
            (folder / path.name).symlink_to(path)
    meta.pop("ply_file_path", None)
    tests = meta["test_filenames"]
    chosen = np.linspace(0, len(tests) - 1, min(test_images or len(tests), len(tests))).round().astype(int)
    meta["test_filenames"] = meta["val_filenames"] = [tests[i] for i in chosen]
    for frame in meta["frames"]:
        if frame["file_path"] in meta["train_filenames"]:
            axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
            move = np.concatenate([way * distance, axis * np.radians(degrees)])
            frame["transform_matrix"] = moved(np.array([frame["transform_matrix"]]), move[None])[0].tolist()
    (folder / "transforms.json").write_text(json.dumps(meta), encoding="utf-8")
    return folder


def moved(poses: Array, moves: Array) -> Array:
    """Poses [N, 4, 4] turned and moved about the world's axes by ``moves`` [N, 6], as nerfstudio's optimiser does."""
    change = exp_map_SO3xR3(torch.from_numpy(moves)).numpy()
    estimates = np.array(poses, np.float64)
    estimates[:, :3, :3] = change[:, :, :3] @ estimates[:, :3, :3]
    estimates[:, :3, 3] += change[:, :, 3]
    return estimates


def training_poses(scene: Path) -> Array:
    """Camera to world [N, 4, 4] of the training images, in the order of their names."""
    meta = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    frames = sorted((f["file_path"], f["transform_matrix"]) for f in meta["frames"])
    return np.array([pose for name, pose in frames if name in meta["train_filenames"]], np.float64)


def pose_errors(exact: Path, scene: Path, run: Path) -> Row:
    """Mean error of the training poses of a run on a scene, against the scene with exact poses: degrees, and units of
    the capture."""
    told = json.loads((run / "dataparser_transforms.json").read_text(encoding="utf-8"))
    to_run, scale = np.vstack([told["transform"], [0, 0, 0, 1]]), told["scale"]
    wanted, estimates = (to_run @ training_poses(folder) for folder in (exact, scene))
    last = max((run / "nerfstudio_models").glob("step-*.ckpt"))
    state = torch.load(last, map_location="cpu", weights_only=True)["pipeline"]
    moves = state.get("_model.camera_optimizer.pose_adjustment")
    if moves is not None:
        numbers = moves.double().numpy()
        estimates = moved(estimates, np.concatenate([numbers[:, :3] / scale, numbers[:, 3:]], -1))
    turned = degrees_between(wanted[:, :3, :3], estimates[:, :3, :3])
    off = np.linalg.norm(wanted[:, :3, 3] - estimates[:, :3, 3], axis=-1)
    return {"degrees_off": float(turned.mean()), "distance_off": float(off.mean())}


def markdown(content: Row) -> str:
    """The page."""
    columns = {
        "training poses": "{name}",
        "off by, degrees": "{degrees_off:.3f}",
        "units": "{distance_off:.3f}",
        "PSNR": "{psnr:.2f}",
        "SSIM": "{ssim:.3f}",
        "PSNR, own pose refined": "{refined_psnr:.2f}",
        "SSIM, own pose refined": "{refined_ssim:.3f}",
        "by, degrees": "{refined_rotation_degrees:.2f}",
    }
    rows = [{"name": name, **row} for name, row in content["rows"].items()]
    intro = (
        "Errors of training poses are means, against the scene's own poses. PSNR and SSIM are `ns-eval`'s means over "
        "the test images, at the scene's own poses. For the last three columns each test image's pose was moved to "
        "where the frozen model shows it best: what the model knows of the scene "
        "whatever frame its poses drifted to, and no score of new views at given poses."
    )
    return page("Refined poses", content["made"], intro, table(columns, rows))


if __name__ == "__main__":
    sys.exit(run("poses", Poses))
