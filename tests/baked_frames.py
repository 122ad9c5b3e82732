"""Frames of a baked folder, without data and checkpoint: seconds of processor time and memory.

    python tests/baked_frames.py FOLDER --scale 4

Each line has the resident memory after a part of the work and the most until then; the last one the time of a frame.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path
from statistics import median

import torch
import tyro


def say(what: str) -> None:
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    print(f"{what}: {pages * resource.getpagesize() / 2**20:.0f} MiB resident, {most:.0f} MiB at most", flush=True)


def main(folder: tyro.conf.Positional[Path], scale: int = 1, frames: int = 8, rounds: int = 3) -> None:
    """Renders.

    Args:
        folder: that mmpi-export bake wrote.
        scale: factor on the images' sides.
        frames: cameras of the path, evenly spaced among those held out.
        rounds: times that each is rendered; the median counts.
    """
    say("torch")
    import numpy as np

    from mmpi_ns.rendering.images import CPU_RAYS
    from mmpi_show.files import read_baked
    from mmpi_show.ops.baked.reader import camera_rays

    torch.set_num_threads(1)
    say("and what reads and renders")
    scene = read_baked(folder)
    say("and the scene")
    poses = [pose for pose in scene.path if pose.test]
    spent = []
    for i in np.linspace(0, len(poses) - 1, frames).astype(int).tolist() * rounds:
        lens = {name: [scale * x for x in getattr(poses[i], name)] for name in ("size", "focal", "center")}
        rays = camera_rays(poses[i].__dict__ | lens)
        origins, directions = (torch.tensor(np.array(x), dtype=torch.float32) for x in rays)
        start = time.process_time()
        parts = zip(origins.split(CPU_RAYS), directions.split(CPU_RAYS), strict=True)
        image = torch.cat([scene.render(*part)["rgb"] for part in parts])
        spent.append(time.process_time() - start)
    say("and frames")
    print(
        f"{lens['size'][0]} x {lens['size'][1]}: {median(spent):.3f} s a frame ({min(spent):.3f} to {max(spent):.3f})"
    )
    assert image.isfinite().all()


if __name__ == "__main__":
    tyro.cli(main)
