"""The variants that are compared on each scene: a method's name and its options, as a user would type them."""

from __future__ import annotations

from dataclasses import dataclass

P = "--pipeline.model.placement."
JOINT = ("--pipeline.model.training", "joint")
TWO_PHASE = ("--pipeline.model.training", "two-phase")
"""As it is unless told otherwise: all rays for each MPI, a little blending, and a long fine-tune at full rates."""
SPLIT = ("--pipeline.model.rays-per-mpi", "split")
DRIVE = (P + "arrangement", "drive")
PLACED = (*JOINT, P + "texel-pixels", "1.5")
FRONT = (*DRIVE, *JOINT, P + "faces", "front")
NO_DEPTH = (
    *("--pipeline.datamanager.keypoint-rays", "0"),
    *("--pipeline.datamanager.dense-depth", "False"),
    *("--pipeline.datamanager.depth-images", "False"),
)
POSES_ALONE = ("--pipeline.datamanager.sfm-path", "none")
"""A COLMAP model that the scene has is not read."""
OPACITY = ("--pipeline.model.blend-form", "opacity")
EQUAL_SHARES = ("--optimizers.reliability.optimizer.lr", "1e-9")
LITTLE_VARIATION = ("--pipeline.model.loss.tv-density", "1e-5", "--pipeline.model.loss.tv-features", "1e-6")
"""DVGO's."""
SHARED = ("--pipeline.model.shared-colour", "True")


@dataclass(frozen=True)
class Variant:
    """One row of a table."""

    name: str
    options: tuple[str, ...]
    method: str = "mmpi-small"
    steps: int | None = 750
    """Training steps; None for the method's own."""
    group: str = ""
    """Rows of one group share a table."""

    @property
    def key(self) -> str:
        """Of its row in a suite."""
        return f"{self.group}: {self.name}" if self.group else self.name


def _paper_ladder(depth: bool) -> list[Variant]:
    """Single, joint, two phases: the paper's ablation on the hand-made drive, with SfM depth in all rows or in none."""
    extra = () if depth else NO_DEPTH
    group = "with SfM depth" if depth else "without SfM depth"
    rows = [
        ("one front MPI at the first camera", (*FRONT, P + "drive-pull-back", "0")),
        ("one front MPI, pulled back", FRONT),
        ("four MPIs, joint, no reliability", (*DRIVE, *JOINT)),
        ("four MPIs, individual, then reliability only", (*DRIVE, *TWO_PHASE, *SPLIT, *_shares(0.25, 0.0))),
        ("... then a joint fine-tune", (*DRIVE, *TWO_PHASE, *SPLIT, *_shares(0.1, 0.4, 0.3))),
        ("four MPIs, two phases as by default", (*DRIVE, *TWO_PHASE)),
        ("automatic placement, joint", PLACED),
    ]
    return [Variant(name, (*options, *extra), group=group) for name, options in rows]


def _shares(blend: float, finetune: float, rate: float = 1.0) -> tuple[str, ...]:
    shares = ("--pipeline.model.blend-share", str(blend), "--pipeline.model.finetune-share", str(finetune))
    return (*shares, "--pipeline.model.finetune-rate", str(rate)) if finetune else shares


DEFAULT = "the default"
"""Of a suite of budgets: what is drawn apart."""
ROOM = (P + "arrangement", "room", P + "width", "160", *JOINT)


def _budgets(*millions: float) -> list[Variant]:
    """Automatic placement held to so many texels, with nothing else that keeps them few, and as it is."""
    free = (P + "rays-per-texel", "0", P + "texels-per-ray", "0")
    held = [Variant(f"{m:g} M texels", (*free, P + "max-texels", f"{m * 1e6:g}"), steps=1500) for m in millions]
    return [*held, Variant(DEFAULT, (), steps=1500)]


SUITES: dict[str, list[Variant]] = {
    "kitti-street": [
        *_paper_ladder(depth=True),
        *_paper_ladder(depth=False),
        # As many steps as take about the time of 750 steps with automatic placement.
        Variant("one front MPI, pulled back, longer", FRONT, steps=2600, group="with SfM depth"),
        Variant("four MPIs, joint, longer", (*DRIVE, *JOINT), steps=1200, group="with SfM depth"),
        Variant("mmpi-small, its defaults", (), steps=None, group="defaults"),
        Variant("four MPIs by hand, joint, as many steps", (*DRIVE, *JOINT), steps=4000, group="defaults"),
        Variant("one front MPI, pulled back, as many steps", FRONT, steps=4000, group="defaults"),
    ],
    "room-walk": [
        Variant("five MPIs and cube, joint", (*ROOM, P + "cube-voxels", "96"), steps=500),
        Variant("five MPIs, joint", ROOM, steps=500),
        Variant("automatic placement, joint", JOINT, steps=500),
    ],
    "fern": [Variant("automatic placement", (), steps=2000)],
    "fox": [Variant("automatic placement", (), steps=750)],
    "object": [  # mmpi-scene object: cameras all round it
        Variant("MPIs placed automatically", (), steps=1500),
        Variant("... and a cube where placement finds it worth it", (P + "max-voxels", "128"), steps=1500),
    ],
    "kitti-street-budgets": _budgets(1.0, 2.0, 4.0, 8.0, 16.0),
    "room-walk-budgets": _budgets(1.0, 2.0, 4.0, 8.0, 16.0),
}


REFERENCE = "four MPIs by hand, joint"
"""What the other variants of a drive are compared with."""
ROOM_REFERENCE = "five MPIs, joint"


def _paper() -> list[Variant]:
    """The paper's ablation: several MPIs gain on one, reliability on them."""
    group, apart = "the paper's ablation", (*DRIVE, *TWO_PHASE)
    rows = [
        (REFERENCE, (*DRIVE, *JOINT)),
        ("one front MPI, pulled back", FRONT),
        ("each alone, then reliability", (*apart, *SPLIT, *_shares(0.25, 0.0))),
        ("... every MPI sees all rays (30k each)", (*apart, *_shares(0.25, 0.0))),
        ("... opacity-keeping form", (*apart, *SPLIT, *_shares(0.25, 0.0), *OPACITY)),
        ("... then a joint fine-tune", (*apart, *SPLIT, *_shares(0.1, 0.4, 0.3))),
        ("... a longer one, at full rates", (*apart, *SPLIT)),
        ("... and every MPI sees all rays (the default)", apart),
        ("... with equal shares instead of reliability", (*apart, *EQUAL_SHARES)),
    ]
    return [Variant(name, options, group=group) for name, options in rows]


def _ours() -> list[Variant]:
    """What we added or chose, one change at a time."""
    hand, placed = "changes of the reference", "automatic placement"
    return [
        Variant("one front MPI, at the first camera", (*FRONT, P + "drive-pull-back", "0"), group=hand),
        Variant("four MPIs, the front one not pulled back", (*DRIVE, *JOINT, P + "drive-pull-back", "0"), group=hand),
        Variant("one colour network for all", (*DRIVE, *JOINT, *SHARED), group=hand),
        Variant("no SfM depth", (*DRIVE, *JOINT, *NO_DEPTH), group=hand),
        Variant("placed among the cameras, joint", JOINT, group=placed),
        Variant("placed, one colour network for all", (*JOINT, *SHARED), group=placed),
        Variant("placed, no SfM depth", (*JOINT, *NO_DEPTH), group=placed),
        Variant("placed, a tenth of the total variation", (*JOINT, *LITTLE_VARIATION), group=placed),
        Variant(
            "placed, each alone, reliability, fine-tune",
            (*TWO_PHASE, *SPLIT, *_shares(0.1, 0.4, 0.3)),
            group=placed,
        ),
        Variant("placed, two phases as by default", TWO_PHASE, group=placed),
    ]


def _depth() -> list[Variant]:
    """What the depths are worth that are found in the training images, from poses alone and beside SfM tracks."""
    alone = POSES_ALONE
    views = ("--pipeline.datamanager.new-view-share", "0")
    dense = ("--pipeline.datamanager.dense-depth", "False")
    return [
        Variant("poses alone, all depths", alone, group="poses alone"),
        Variant("no new views", (*alone, *views), group="poses alone"),
        Variant("no dense depths", (*alone, *dense), group="poses alone"),
        Variant("no depth", (*alone, *NO_DEPTH), group="poses alone"),
        Variant("with SfM tracks, all depths", (), group="with SfM tracks"),
        Variant("with SfM tracks, no new views", views, group="with SfM tracks"),
        Variant("with SfM tracks, no dense depths", dense, group="with SfM tracks"),
    ]


ABLATIONS: dict[str, list[Variant]] = {
    "depth": _depth(),
    "drive": [*_paper(), *_ours()],
    "room": [
        Variant(ROOM_REFERENCE, ROOM, group="the paper's ablation"),
        Variant("five MPIs and cube, joint", (*ROOM, P + "cube-voxels", "96"), group="the paper's ablation"),
        Variant("placed among the cameras, joint", JOINT, group="automatic placement"),
    ],
}
"""The first variant of each is the reference."""
