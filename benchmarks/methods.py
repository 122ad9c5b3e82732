"""The methods that are trained side by side: ours and nerfstudio's, as words for ``ns-train``, and what each needs."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import torch
from trainers import BARE, P, Scene, train_words

TWO_PHASE = ("--pipeline.model.schedule.training", "two-phase")
"""All rays for each MPI, a little blending, and a long fine-tune at full rates, unless more options follow."""
NO_DEPTH = (
    *("--pipeline.datamanager.keypoint-rays", "0"),
    *("--pipeline.datamanager.priors.dense-depth", "False"),
    *("--pipeline.datamanager.priors.depth-images", "False"),
)
POSES_ALONE = ("--pipeline.datamanager.priors.sfm-path", "none")
"""A COLMAP model or point cloud that the scene has is not read."""


@dataclass(frozen=True)
class Method:
    """One way to train a scene."""

    name: str
    """What the tables call it."""
    registered: str
    """nerfstudio's name of it."""
    options: tuple[str, ...] = ()
    """As for ns-train."""
    steps: int = 1500
    """Steps unless told otherwise; 0 for its own."""
    needs: tuple[str, ...] = ()
    """Modules that must be installed, and "cuda"."""
    whole_images: bool = False
    """Splats images instead of tracing rays: cannot render single pixels."""
    batch_option: str | None = "--pipeline.datamanager.train-num-rays-per-batch"
    """The option that sets the rays of a step; None: has none."""
    camera_option: tuple[str, ...] = ()
    """What turns the optimisation of cameras off."""
    hashes: bool = False
    """Looks up hash tables in plain torch on a CPU, which ``peers.look_up_quickly`` can do instead."""
    given: str = "SfM tracks"
    """Beside training images and poses."""
    wants_depths: bool = False
    """Reads depth images: ``peers.give_depths`` gives it those that our methods find."""
    group: str = ""
    """Of variants of a method: those of one group share a table."""

    @property
    def key(self) -> str:
        """Of a variant's row."""
        return f"{self.group}: {self.name}" if self.group else self.name

    @property
    def ours(self) -> bool:
        return self.registered.startswith("mmpi")

    def why_not(self) -> str | None:
        """Why it cannot run on this machine; None: it can."""
        for module in self.needs:
            if module == "cuda" and not torch.cuda.is_available():
                return "it needs a CUDA device, and torch sees none"
            if module != "cuda" and importlib.util.find_spec(module) is None:
                return f"the module {module} is not installed"
        return None

    def words(self, scene: Scene, folder: Path, steps: int, rays: int | None, seed: int, device: str) -> list[str]:
        """``train_words`` of this method; ``rays`` of a step, None leaves them to the method."""
        options = [*(BARE if self.ours else ()), *self.options, *self.camera_option]
        if rays is not None and self.batch_option is not None:
            options += [self.batch_option, str(rays)]
        words = train_words(self.registered, options, scene, folder, steps, seed, device)
        if self.whole_images or POSES_ALONE[0] in self.options:
            words += ["--load-3D-points", str(self.whole_images)]
        return words


def _nerfacto_options() -> tuple[str, ...]:
    fast = torch.cuda.is_available() and importlib.util.find_spec("tinycudann") is not None
    return ("--pipeline.model.implementation", "tcnn" if fast else "torch")


CAMERAS_OFF = ("--pipeline.model.camera-optimizer.mode", "off")
_SPLATS = {"registered": "splatfacto", "needs": ("cuda", "gsplat"), "whole_images": True, "batch_option": None}
_SPLATS |= {"camera_option": CAMERAS_OFF, "given": "SfM points"}
METHODS = {
    m.name: m
    for m in (
        Method("mmpi-small", "mmpi-small", steps=4000),
        Method("poses alone", "mmpi-small", POSES_ALONE, steps=4000, given="nothing (finds depths itself)"),
        Method("no depth", "mmpi-small", (*POSES_ALONE, *NO_DEPTH), steps=4000, given="nothing (no depths)"),
        Method("mmpi", "mmpi", steps=20_000),
        Method("single", "mmpi-small", (P + "max-mpis", "1"), steps=4000),
        Method("two-phase", "mmpi-small", TWO_PHASE, steps=4000),
        Method("mmpi-kitti", "mmpi-kitti", steps=40_000),
        Method("mmpi-scannet", "mmpi-scannet", steps=30_000),
        Method("mmpi-scannet-short", "mmpi-scannet-short", steps=10_000),
        Method("nerfacto", "nerfacto", _nerfacto_options(), camera_option=CAMERAS_OFF, hashes=True, given="nothing"),
        Method(
            "depth-nerfacto",
            "depth-nerfacto",
            (*_nerfacto_options(), "--pipeline.model.is-euclidean-depth", "True"),
            camera_option=CAMERAS_OFF,
            hashes=True,
            given="the depths of mmpi-small",
            wants_depths=True,
        ),
        # It has no camera optimiser. Its batches adapt themselves to the samples of a ray.
        Method(
            "instant-ngp", "instant-ngp", steps=10_000, needs=("cuda", "nerfacc"), batch_option=None, given="nothing"
        ),
        Method("splatfacto", steps=10_000, **_SPLATS),
        # Its schedules, made for 30,000 steps, in 3,500; at full size from the first one.
        Method(
            "splatfacto-short",
            options=(
                *("--pipeline.model.num-downscales", "0", "--pipeline.model.stop-split-at", "2500"),
                *("--optimizers.means.scheduler.max-steps", "3500"),
            ),
            steps=3500,
            **_SPLATS,
        ),
    )
}


def find_method(name: str) -> Method:
    """A method by its name in the tables.

    Raises:
        ValueError: there is none of that name.
    """
    if name not in METHODS:
        raise ValueError(f"There is no method {name!r}: choose from {', '.join(METHODS)}.")
    return METHODS[name]
