"""``mmpi-export``: exports a trained model as a baked scene, a web page, or splats."""

from __future__ import annotations

import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mmpi_ns.scripts.command import run
from mmpi_ns.utils.errors import looked_at, quoted
from mmpi_ns.utils.files import make_writable
from mmpi_ns.utils.values import Number, check_options

if TYPE_CHECKING:
    from mmpi_show.files import BakedScene

UNFINISHED = r"window-\d{5}\.bin|\.(window-\d{5}\.bin|scene\.json)\.\d+\.tmp|index\.html"
"""Files of an unfinished export, without a header, which the next one may replace."""


@dataclass
class _Run:
    load_config: Path
    """config.yml of a finished run."""
    least: float = 0.003
    """Bricks without a sample of this weight in any training view are dropped; 0 keeps all."""
    compare: int = 5
    """Test images to compare with the exact renderer; 0 for none."""
    overwrite: bool = False
    """Replace an existing export."""

    def check_paths(self, output: Path, is_file: bool = False) -> None:
        """Check of the options; makes the output folder.

        Raises:
            ValueError: an option is out of range, there is no run, it has no checkpoint, there is something that an
                export would not replace, or the folder cannot be written.
        """
        check_options(self, {"least": Number(0, 1), "compare": Number(0, whole=True)}, "--")
        if not self.load_config.is_file():
            where = looked_at(self.load_config)
            raise ValueError(f"There is no run at {where}: give the config.yml that ns-train wrote.")
        folder = self.load_config.parent / "nerfstudio_models"
        if not any(folder.glob("step-*.ckpt")):
            raise ValueError(f"The run has no checkpoint in {folder}: train it at least until its first checkpoint.")
        if is_file:
            windows = output.parent.glob(f"{output.stem}-[0-9][0-9][0-9][0-9][0-9]{output.suffix}")
            if not self.overwrite and (there := [path for path in (output, *windows) if path.exists()]):
                raise ValueError(f"{there[0]} is there already: name another file, or give --overwrite.")
        elif output.exists() and not output.is_dir():
            raise ValueError(f"{output} is a file: name a folder to write.")
        elif (output / "scene.json").is_file():
            if not self.overwrite:
                raise ValueError(f"{output} holds an export already: name another folder, or give --overwrite.")
        elif output.is_dir():
            names = {path.name for path in output.iterdir()}
            if names == {"index.html"} or not all(re.fullmatch(UNFINISHED, name) for name in names):
                raise ValueError(f"{output} holds other files: name an empty folder, or one that does not exist.")
        make_writable(output.parent if is_file else output, "--output")

    def bake(self, details: bool = True) -> BakedScene:
        """Bakes the run's scene, with details or its field alone, and prints the loss of quality."""
        # Slow imports, not needed for --help and errors.
        from mmpi_show.bake import bake_run, compare, load_model

        pipeline = load_model(self.load_config, details)
        scene = bake_run(pipeline, self.least)
        if self.compare > 0:
            rows = compare(pipeline, scene, self.compare)
            words = {k: f"{m['psnr']:.2f} dB, SSIM {m['ssim']:.4f}, {m['seconds']:.3f} s" for k, m in rows.items()}
            print(
                f"Baked images have {rows['baked']['to_exact']:.1f} dB to the exact renderer's;\n"
                f"  against the truth {words['baked']} a frame (processor time),\n  exact {words['exact']}."
            )
        return scene


@dataclass
class Bake(_Run):
    """Writes a baked scene: a folder with scene.json and the bricks of every window (docs/export.md)."""

    output: Path | None = None
    """Folder to write (default: 'baked' beside config.yml)."""

    def main(self) -> None:
        folder = self.output or self.load_config.parent / "baked"
        self.check_paths(folder)
        scene = self.bake()
        from mmpi_show.files import write_baked

        size = write_baked(scene, folder)
        print(f"Wrote {folder}: {size / 1e6:.1f} MB.")


@dataclass
class Web(_Run):
    """Writes an interactive web page of the scene (WebGL2): a folder for any web server, or one file."""

    output: Path = Path("site")
    """Folder to write; with --single-file, the file."""
    single_file: bool = False
    """One HTML file that opens by a double click."""

    def main(self) -> None:
        path = self.output if self.output.suffix == ".html" or not self.single_file else self.output / "index.html"
        self.check_paths(path, is_file=self.single_file)
        scene = self.bake()
        from mmpi_show.files import write_baked
        from mmpi_show.web import write_page

        if self.single_file:
            with tempfile.TemporaryDirectory(dir=path.parent) as folder:
                write_baked(scene, Path(folder))
                write_page(Path(folder), path)
            print(f"Wrote {path}: {path.stat().st_size / 1e6:.1f} MB. Open it in a browser.")
            return
        size = write_baked(scene, self.output)
        write_page(self.output)
        print(f"Wrote {self.output}: {size / 1e6:.1f} MB. To look at it:")
        print(f"  python -m http.server --directory {quoted(self.output)}    # and open http://localhost:8000")


@dataclass
class Splats(_Run):
    """Writes Gaussians in the .ply format of 3D Gaussian splatting viewers; one file for each window."""

    output: Path = Path("scene.ply")
    """File to write; scene-00000.ply and so on if there are several windows."""
    weight: float = 0.01
    """Texels without this weight in any training view are dropped."""
    most: int = 1_000_000
    """Maximum number of splats of a window."""

    def main(self) -> None:
        self.check_paths(self.output, is_file=True)
        from mmpi_ns.ops import dispatch

        if dispatch.fault("C++") is not None:
            raise ValueError("Colours of splats are fitted by compiled code: install a C++ compiler (g++ or clang++).")
        scene = self.bake(details=False)  # splats have none
        import torch

        from mmpi_ns.scene.windows import window_shares
        from mmpi_show.splats import splats_of, write_ply

        cameras = [pose for pose in scene.path if not pose.test]
        centers = torch.tensor([pose.to_world for pose in cameras])[:, :, 3]
        shares = window_shares(centers, tuple(place for place, _ in scene.windows))

        for number, (_, window) in enumerate(scene.windows):
            path = self.output.with_stem(f"{self.output.stem}-{number:05d}") if len(scene.windows) > 1 else self.output
            poses = [pose for pose, share in zip(cameras, shares[:, number].tolist(), strict=True) if share > 0]
            splats = splats_of(window, poses, self.weight, self.most)
            size = write_ply(splats, path)
            print(f"Wrote {path}: {len(splats.means)} splats, {size / 1e6:.1f} MB.")


Command = Bake | Web | Splats


def entrypoint() -> None:
    """The command ``mmpi-export``; an error is one sentence and exit status 1."""
    sys.exit(run("mmpi-export", Command, description=__doc__))


if __name__ == "__main__":
    entrypoint()
