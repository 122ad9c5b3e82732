"""How far a training has come: its curve so far and where its checkpoints lie, from which a later process goes on."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mmpi_ns.bench.report import read_json, write_json

FILE = "progress.json"


@dataclass
class Progress:
    """What a run that goes on must know of the run before."""

    words: list[str]
    """What ``ns-train`` was asked for, but for the number of steps."""
    curve: list[dict[str, float]] = field(default_factory=list)
    """One point for each look: step, rays, seconds by the clock and of processors, psnr."""
    rays: int = 0
    setup_seconds: float = 0.0
    checkpoints: str = ""
    """Folder."""

    @property
    def step(self) -> int:
        """Steps made until the last look."""
        return int(self.curve[-1]["step"]) if self.curve else 0

    @property
    def seconds(self) -> float:
        return self.curve[-1]["seconds"] if self.curve else 0.0

    @property
    def processor(self) -> float:
        return self.curve[-1]["processor"] if self.curve else 0.0

    def save(self, trainer: Any, folder: Path) -> None:
        """Saves a checkpoint of nerfstudio's trainer, and then what belongs to it."""
        trainer.save_checkpoint(self.step - 1)
        self.checkpoints = str(trainer.checkpoint_dir)
        write_json(folder / FILE, asdict(self))

    @staticmethod
    def before(words: tuple[str, ...], folder: Path, last: int) -> Progress:
        """That of a run in this folder from which one of ``last`` steps can go on; else none yet."""
        own = without_length(words)
        path = folder / FILE
        if path.is_file():
            found = Progress(**read_json(path))
            saved = Path(found.checkpoints) / f"step-{found.step - 1:09d}.ckpt"
            if found.words == own and 0 < found.step < last and saved.is_file():
                return found
        return Progress(own)


def without_length(words: tuple[str, ...]) -> list[str]:
    """Words for ``ns-train`` but for how many steps it shall make."""
    return [w for i, w in enumerate(words) if i == 0 or words[i - 1] != "--max-num-iterations"]
