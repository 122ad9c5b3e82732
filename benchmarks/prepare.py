"""Mmpi-prepare on bare images of captures with known poses: error, time and verdict."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from captures import Array, Truth, catalogue
from lab import not_run
from report import Bench, Report, Row, commit, page, table

from mmpi_ns.scripts.command import run
from mmpi_prepare.adjustment import degrees_between, nearest_rotation
from mmpi_prepare.pipeline import WORK

WRONG = (0.01, 0.03)
"""Mean and largest error of the camera centres, as shares of the length of the track, from which a track is wrong."""
GRADES = {0: "right", 1: "refused", 3: "doubtful"}
"""By the exit status of mmpi-prepare."""


@dataclass
class Prepare(Bench):
    """Runs mmpi-prepare on bare images and compares what comes out with the known poses.

    A green end with a wrong track is a false green, a red one or a refusal of a right track a false red: what was
    refused is made all the same, to be measured. --only chooses rows, and several runs add up: finished rows are kept,
    each with the commit that made it.
    """

    data: Path
    """Folder of the real captures: kitti-street, long-road, fern, fox, room-walk."""
    only: tuple[str, ...] = ()
    """Rows to make; all unless given. A name ending in * stands for all that begin so."""
    anew: bool = False
    """Make chosen rows again that are there."""
    focal_given: bool = False
    """Give --focal with the known focal length."""

    name = "prepare"

    def run(self) -> None:
        report = Report(self, key=f"{self.cores}", file="prepare-focal" if self.focal_given else "")
        captures = catalogue()
        for name in captures:
            if not self.only or any(name == o or (o.endswith("*") and name.startswith(o[:-1])) for o in self.only):
                if self.anew:
                    report.rows.pop(name, None)
                    shutil.rmtree(self.folder / name / "scene", ignore_errors=True)
                row = report.row(name, lambda name=name: self._measure(name), needed=False)
                print(f"{name}: {row}", flush=True)
        rows = {name: report.rows[name] for name in captures if name in report.rows}
        head = headline([r for r in rows.values() if "grade" in r])
        report.finish(head, markdown(rows, head, report.content["made"]))
        print(head)

    def _measure(self, name: str) -> Row:
        folder = self.folder / name
        try:
            truth = catalogue()[name].write(self.data, folder / "images")
        except (ValueError, OSError) as error:
            return {"not_run": str(error)}
        options = ["--threads", str(self.cores), "--keep-work", "--overwrite"]
        goes_on = (folder / "scene" / WORK).exists()  # its time would be that of the rest
        options += ["--focal", f"{truth.focal}"] if self.focal_given else []
        row = run_prepare(folder / "images", folder / "scene", options)
        if goes_on:
            del row["seconds"], row["cpu_seconds"]
        if row["grade"] == "refused":  # go on from there: was that right?
            run_prepare(folder / "images", folder / "scene", [*options, "--allow-doubtful", "--allow-partial"])
        row |= {"images": len(truth.names), "focal_true": truth.focal, "commit": commit()}
        return row | compare(folder / "scene", truth)


def run_prepare(images: Path, scene: Path, options: list[str]) -> Row:
    """mmpi-prepare in a process of its own: its verdict, its last words, and its time."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    command = [sys.executable, "-m", "mmpi_prepare.__main__", str(images), str(scene), *options]
    made = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "COLUMNS": "120"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    intro = [line for line in made.stdout.splitlines() if line.startswith(("mmpi-prepare:", "This scene is"))]
    row: Row = {"grade": GRADES.get(made.returncode, f"status {made.returncode}"), "says": " ".join(intro)}
    row |= {"seconds": time.monotonic() - start}
    return row | {"cpu_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}


def compare(scene: Path, truth: Truth) -> Row:
    """Errors of a scene's poses after the best similarity of the centres; nothing where no scene was made."""
    path = scene / "transforms.json"
    if not path.is_file():
        return {"registered": 0}
    meta: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    results = {Path(f["file_path"]).name: np.array(f["transform_matrix"]) for f in meta["frames"]}
    kept = [i for i, name in enumerate(truth.names) if name in results]
    poses: Array = np.array([results[truth.names[i]] for i in kept], dtype=np.float64)
    off, turned = pose_errors(poses[:, :3, 3], poses[:, :3, :3] * [1.0, -1.0, -1.0], truth, kept)
    track = float(np.linalg.norm(np.diff(truth.centers, axis=0), axis=-1).sum())
    return {
        "registered": len(kept),
        "focal": float(meta["fl_x"]),
        "track": track,
        "center_mean": float(off.mean()),
        "center_max": float(off.max()),
        "turn_mean": float(turned.mean()),
        "is_wrong": bool(off.mean() > WRONG[0] * track or off.max() > WRONG[1] * track),
    }


def pose_errors(centers: Array, rotations: Array, truth: Truth, kept: list[int]) -> tuple[Array, Array]:
    """Distances of the centres after their best similarity, and degrees between rotations after their best rotation.

    The two are aligned each for itself: a principal point that was taken to be the middle turns all cameras alike.

    Args:
        centers: of the images kept. [N, 3]
        rotations: camera to world, OpenCV axes. [N, 3, 3]
        truth: of all images.
        kept: places of the images in it.
    """
    scale, rotation, shift = similarity_of_centers(centers, truth.centers[kept])
    off = np.linalg.norm(scale * centers @ rotation.T + shift - truth.centers[kept], axis=-1)
    best = nearest_rotation(np.einsum("nij,nkj->ik", truth.rotations[kept], rotations))
    return off, degrees_between(best @ rotations, truth.rotations[kept])


def similarity_of_centers(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale, rotation [3, 3] and translation [3] that align points with others in the least-squares sense.

    ``pycolmap.estimate_sim3d`` gives up where all points lie on a plane, as the track of a car does.

    Args:
        source, target: [N, 3]

    Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns (1991).
    """
    a, b = source - source.mean(0), target - target.mean(0)
    rotation = nearest_rotation(b.T @ a)
    scale = float((a @ rotation.T * b).sum() / max((a * a).sum(), 1e-24))
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def headline(rows: list[Row]) -> Row:
    """Counts of what matters."""
    green = [r for r in rows if r["grade"] == "right"]
    return {
        "captures": len(rows),
        "right": sum(not r.get("is_wrong", True) for r in green),
        "false_green": sum(r.get("is_wrong", True) for r in green),
        "false_red": sum(r["grade"] != "right" and not r.get("is_wrong", True) for r in rows),
    }


def markdown(rows: dict[str, Row], head: Row, made: Row) -> str:
    """The page: a table, and what was said where it was not green."""

    def error(row: Row) -> str:
        if "center_mean" not in row:
            return "-"
        return f"{row['center_mean']:.3f} / {row['center_max']:.3f} of {row['track']:.3g}"

    done = [{"name": n, **r} for n, r in rows.items() if "grade" in r]
    columns = {
        "capture": "{name}",
        "registered": "{registered} of {images}",
        "centres off, mean / max": error,
        "turned by": lambda r: f"{r['turn_mean']:.2f}°" if "turn_mean" in r else "-",
        "focal length, known": lambda r: f"{r.get('focal', float('nan')):.1f}, {r['focal_true']:.1f}",
        "verdict": "{grade}",
        "clock": lambda r: f"{r['seconds']:.0f} s" if "seconds" in r else "-",
        "CPU": lambda r: f"{r['cpu_seconds']:.0f} s" if "seconds" in r else "-",
        "commit": "{commit}",
    }
    wrong = f"{head['false_green']} wrong and said to be right, {head['false_red']} right and said not to be"
    counts = f"{head['captures']} captures; {head['right']} right and said to be so, {wrong}."
    says = "\n".join(f"- {r['name']}: {r['says']}" for r in done if r["says"])
    note = (
        "Centres in the units of the known poses, after the best similarity; refused ones as they would have been. "
        "No time: the run went on from one that was interrupted."
    )
    return page("mmpi-prepare on bare images", made, counts, table(columns, done), note, says, not_run(rows))


if __name__ == "__main__":
    sys.exit(run("prepare", Prepare))
