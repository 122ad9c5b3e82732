"""Options of placement: valid values, and defaults that follow the capture. Quick to import."""

from __future__ import annotations

from mmpi_ns.scene.plan import MOST_PLANES, MOST_TEXELS, MOST_VOXELS
from mmpi_ns.settings import PlacementConfig
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.values import Number, as_text, check_options

STEPS, LEAST_STEPS, RAYS = 4000, 2500, 1024
"""Training steps of a capture of ``FEW`` to ``MANY`` pixels, minimum for one of fewer pixels, and rays of a step:
minutes on a CPU."""
PLACEMENT = PlacementConfig(texel_pixels=1.2)
FEW, MANY = 2.6e6, 10.4e6
"""Training pixels of a window below which steps decrease in proportion, and above which they increase."""
MOST_TIMES = 3.0
"""Largest multiple of the steps."""
GPU_MULTIPLE, RAYS_PER_PIXEL = 4.0, 2.0
"""Factor on the rays of a run on a GPU; and rays per training pixel up to which a run may be longer than the default:
beyond, images do not improve (docs/results/README.md, "Longer and shorter")."""
LEAST_TIMES = 1.5
"""Least multiple of the default steps that this limit must allow; below it, a run is not made longer."""
RAYS_PER_PROCESSOR = 256
"""Pixel rays of a step per multiprocessor of a GPU."""
MOST_RAYS_TIMES = 4
"""Maximum factor on a method's rays, by which steps are divided. The same rays in a quarter of the steps give equally
good images, in an eighth worse ones."""
POSITIVE, NOT_NEGATIVE = Number(0, above=True), Number(0)
RANGES = {
    "max_mpis": Number(1, 10_000, whole=True),
    **dict.fromkeys(("planes", "max_planes"), Number(2, MOST_PLANES, whole=True)),
    **dict.fromkeys(("height", "width"), Number(2, MOST_TEXELS, whole=True)),
    "cube_voxels": Number(0, MOST_VOXELS, whole=True),
    **dict.fromkeys(("plane_pixels", "texel_pixels"), POSITIVE),
    **dict.fromkeys(("max_texels", "rays_per_texel"), NOT_NEGATIVE),
    **dict.fromkeys(("min_gain", "window_length"), NOT_NEGATIVE),
}
FACES = ("front", "left", "right", "below")


def rays_times(processors: int) -> int:
    """Factor on the rays per step of a run with defaults, by which its steps are divided; a power of two.
    ``processors`` are the multiprocessors of the GPU, 0 on a CPU."""
    fit = RAYS_PER_PROCESSOR * processors // RAYS
    return min(1 << max(fit, 1).bit_length() - 1, MOST_RAYS_TIMES)


def steps_for(pixels: float, size: float = 1.0, times: int = 1) -> int:
    """Training steps of a window, in hundreds, by its training pixels (``FEW``, ``MANY``).

    They are multiplied by ``size`` up to ``RAYS_PER_PIXEL`` (see ``LEAST_TIMES``) and divided by ``times``, the factor
    on the rays per step (``rays_times``). A GPU, whose ``times`` are above 1, takes more rays (``GPU_MULTIPLE``).
    """
    steps = max(LEAST_STEPS, STEPS * min(pixels / FEW, max(1.0, pixels / MANY), MOST_TIMES))
    multiple = size * (GPU_MULTIPLE if times > 1 else 1.0)
    most = RAYS_PER_PIXEL * pixels / RAYS
    steps = min(multiple * steps, most if most >= LEAST_TIMES * steps else steps)
    return 100 * max(1, round(steps / 100)) // times


def check_placement(config: PlacementConfig, prefix: str) -> None:
    """Raises InputError naming the option, with its prefix on the command line, whose value cannot be used."""
    check_options(config, RANGES, prefix)
    if not config.faces or not set(config.faces) <= set(FACES):
        raise InputError(f"{prefix}faces must be some of {', '.join(FACES)}, not {as_text(config.faces)}.")
