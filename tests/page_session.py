"""The page of a run in a real browser against the baked scene in Python, the exact renderer and the truth.

    python tests/page_session.py --load-config RUN/config.yml

Prints a line for each test camera and what is lost on average. Fails where the canvas has less than 38 dB to the image
that Python renders of the same baked scene, or on average more than 0.1 dB less against the truth. What the baked
scene's codes lose to the exact renderer is printed, too: since they hold details, a few tenths of a decibel
(docs/ablations.md).
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
import tyro
from browser import browser, served

from mmpi_ns.data.rays import image_rays
from mmpi_ns.rendering.metrics import ImageMetrics
from mmpi_show.bake import bake_run, load_model
from mmpi_show.files import read_header, write_baked
from mmpi_show.web import write_page

LEAST_DB, MOST_LOST = 38.0, 0.1
WHOLE = "[...mmpi.windows.values()].every((w) => w && w.whole)"
DETAILED = "(!mmpi.details.nearest || mmpi.details.views.length > 0 && mmpi.details.ready(mmpi.camera))"
FIRST_PARTS = """(async () => {
    window.whole = new Map(mmpi.windows);
    window.views = mmpi.details.views.splice(0);
    for (const w of mmpi.windows.keys()) {
        const row = mmpi.header.windows[w];
        mmpi.windows.set(w, await WindowOnCard.load(mmpi.gl, row, await mmpi.source(row, () => {})[0], mmpi.details));
    }
})()"""
"""Shows what the page shows before the rest of the windows has come."""


def main(load_config: Path, cameras: int = 5, least: float = 0.003) -> None:
    """Compares.

    Args:
        load_config: the run's config.yml.
        cameras: test cameras, evenly spaced.
        least: bricks in which no training view sees this weight are left out.
    """
    pipeline = load_model(load_config, details=True)
    train, test = pipeline.datamanager.train_dataset, pipeline.datamanager.eval_dataset
    places = sorted(str(name) for dataset in (train, test) for name in dataset.image_filenames)
    metrics, close, lost, coded, early = ImageMetrics("none"), [], [], [], []
    with tempfile.TemporaryDirectory() as name, torch.no_grad():
        site = Path(name) / "site"
        scene = bake_run(pipeline, least)
        size = write_baked(scene, site)
        first_bytes = sum(row["first_bytes"] for row in read_header(site)["windows"])
        print(f"{size / 1e6:.1f} MB, first parts {first_bytes / 1e6:.2f} MB ({100 * first_bytes / size:.1f} %)")
        write_page(site)
        with served(site) as address, browser(Path(name) / "profile", size=(640, 360)) as tab:
            start = time.perf_counter()
            assert tab.open(f"{address}/index.html") == "ready", tab.messages
            print(f"first picture after {time.perf_counter() - start:.1f} s")
            tab.until(WHOLE, 120)
            print(f"all there after {time.perf_counter() - start:.1f} s")
            for i in np.linspace(0, len(test) - 1, cameras).astype(int).tolist():
                camera = f"mmpi.path[{places.index(str(test.image_filenames[i]))}]"
                tab.evaluate(
                    f"mmpi.camera = structuredClone({camera}); mmpi.touched()"
                )  # its frames fetch what it needs
                tab.until(f"{WHOLE} && {DETAILED}", 120)
                draw = f"(mmpi.draw({camera}, ...{camera}.size), mmpi.gl.canvas.toDataURL())"
                shown = tab.picture(draw)
                tab.evaluate(FIRST_PARTS)
                first = torch.from_numpy(tab.picture(draw)).float()
                tab.evaluate("mmpi.windows.forEach((w) => w.free()); mmpi.windows = whole; mmpi.details.views = views")
                rays, truth = image_rays(test.cameras[i : i + 1]), test[i]["image"][..., :3]
                exact = pipeline.model.get_outputs_for_camera_ray_bundle(rays)["rgb"].cpu()
                canvas, baked = torch.from_numpy(shown).float(), scene.image(rays)["rgb"].cpu()
                close.append(metrics(canvas, baked)["psnr"])
                ours, stored, theirs = (metrics(image, truth)["psnr"] for image in (exact, baked, canvas))
                lost.append(stored - theirs)
                coded.append(ours - stored)
                early.append(metrics(first, exact)["psnr"])
                first_db = metrics(first, truth)["psnr"]
                print(
                    f"{test.image_filenames[i].name}: {close[-1]:.1f} dB to the baked scene in Python; exact "
                    f"{ours:.2f}, baked {stored:.2f}, page {theirs:.2f} dB; "
                    f"the first picture {early[-1]:.1f} dB to exact, {first_db:.2f} dB"
                )
            assert not tab.messages, tab.messages
    print(f"at least {min(close):.1f} dB to the baked scene")
    print(f"{fmean(lost):.3f} dB lost to it on average, {max(lost):.3f} at most")
    print(f"the codes of the baked scene lose {fmean(coded):.3f} dB to the exact renderer")
    print(f"first pictures: {fmean(early):.1f} dB to exact")
    assert min(close) >= LEAST_DB and fmean(lost) <= MOST_LOST


if __name__ == "__main__":
    tyro.cli(main)
