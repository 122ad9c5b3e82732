"""Milliseconds of the steps of a trained run, and of an image without details, on a CPU, with several numbers of
threads in turn.

python benchmarks/steps.py mmpi --data CAPTURE --load-dir RUN/nerfstudio_models --steps 2500 --at 1400
python benchmarks/steps.py mmpi-kitti --data CAPTURE --load-dir RUN/nerfstudio_models --steps 2500 --at 2440 --rays 4096

``--steps`` are those of the run, and ``--at`` is the first one that is repeated: the schedule's phase at that step.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from statistics import median

import torch
from trainers import BARE, Scene, Steps, train_words

from mmpi_ns.utils.host import keep_freed_memory
from mmpi_ns.utils.parallel import torch_apart

ROUNDS, COUNT, FIRST = 5, 20, 4
"""Rounds, steps of a round, and untimed ones in front of them."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("method")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--downscale-factor", type=int, default=4)
    parser.add_argument("--load-dir", type=Path, required=True, help="checkpoint of the run")
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--at", type=int, required=True)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    args = parser.parse_args()
    options = (*BARE, "--load-dir", str(args.load_dir))
    options += ("--pipeline.datamanager.train-num-rays-per-batch", str(args.rays))
    with tempfile.TemporaryDirectory() as folder:
        scene = Scene(args.data, args.downscale_factor)
        steps = Steps(train_words(args.method, options, scene, Path(folder), args.steps, 0, "cpu"))
        times: dict[int, list[float]] = {n: [] for n in args.threads}
        for _ in range(ROUNDS):
            for threads, found in times.items():
                torch.set_num_threads(threads)
                steps.step = args.at
                with torch_apart(), keep_freed_memory():  # as the trainer does
                    steps.run(FIRST)
                    found.append(1e3 * steps.run(COUNT) / COUNT)
    for threads, found in times.items():
        torch.set_num_threads(threads)
        frame = median(1e3 * steps.render()[0] for _ in range(ROUNDS * FIRST))
        step = f"{median(found):.1f} ms a step ({min(found):.1f} to {max(found):.1f})"
        print(f"{threads} thread(s): {step}, {frame:.1f} an image")


if __name__ == "__main__":
    main()
