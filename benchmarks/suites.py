"""The variants that are compared on each scene: a method's name and its options, as a user would type them."""

from __future__ import annotations

from methods import NO_DEPTH, POSES_ALONE, SPLIT, TWO_PHASE, Method

from mmpi_ns.bench.trainers import JOINT, P

DRIVE = (P + "arrangement", "drive")
BY_HAND = (*DRIVE, *JOINT)
FRONT = (*BY_HAND, P + "faces", "front")
EQUAL_SHARES = ("--optimizers.reliability.optimizer.lr", "1e-9")
LITTLE_VARIATION = ("--pipeline.model.loss.tv-density", "1e-5", "--pipeline.model.loss.tv-features", "1e-6")
"""DVGO's."""
DEFAULT = "the default"
"""Of a suite of budgets: what is drawn apart."""
ROOM = (P + "arrangement", "room", P + "width", "160", *JOINT)
ROOM_CUBE = (*ROOM, P + "cube-voxels", "96")


def _shares(blend: float, finetune: float = 0.0) -> tuple[str, ...]:
    names = ("--pipeline.model.schedule.blend-share", "--pipeline.model.schedule.finetune-share")
    return names[0], str(blend), names[1], str(finetune)


ALONE = (*DRIVE, *TWO_PHASE, *_shares(0.25))
"""Each MPI alone, then reliability."""


def _group(name: str, rows: dict[str, tuple[str, ...]], steps: int = 750) -> list[Method]:
    """Variants of mmpi-small that share a table; 0 steps for its own."""
    return [Method(row, "mmpi-small", options, steps, group=name) for row, options in rows.items()]


def _paper_ladder(group: str, extra: tuple[str, ...]) -> list[Method]:
    """Single, joint, two phases: the paper's ablation on the hand-made drive, with SfM depth in all rows or in none."""
    rows = {
        "one front MPI, pulled back": FRONT,
        "four MPIs, joint, no reliability": BY_HAND,
        "four MPIs, individual, then reliability only": (*DRIVE, *TWO_PHASE, *SPLIT, *_shares(0.25)),
        "... then a joint fine-tune": (*DRIVE, *TWO_PHASE, *SPLIT, *_shares(0.1, 0.4)),
        "four MPIs, two phases as by default": (*DRIVE, *TWO_PHASE),
        "automatic placement, joint": (*JOINT, P + "texel-pixels", "1.5"),
    }
    return _group(group, {name: (*options, *extra) for name, options in rows.items()})


def _budgets(*millions: float) -> list[Method]:
    """Automatic placement held to so many texels, with nothing else that keeps them few, and as it is."""
    free = (P + "rays-per-texel", "0", P + "max-texels")
    return _group("", {f"{m:g} M texels": (*free, f"{m * 1e6:g}") for m in millions} | {DEFAULT: ()}, 1500)


SUITES: dict[str, list[Method]] = {
    "kitti-street": [
        *_paper_ladder("with SfM depth", ()),
        *_paper_ladder("without SfM depth", NO_DEPTH),
        # As many steps as take about the time of 750 steps with automatic placement.
        *_group("with SfM depth", {"one front MPI, pulled back, longer": FRONT}, 2600),
        *_group("with SfM depth", {"four MPIs, joint, longer": BY_HAND}, 1200),
        *_group("defaults", {"mmpi-small, its defaults": ()}, 0),
        *_group("defaults", {"four MPIs by hand, joint, as many steps": BY_HAND}, 4000),
        *_group("defaults", {"one front MPI, pulled back, as many steps": FRONT}, 4000),
    ],
    "room-walk": _group(
        "",
        {
            "five MPIs and cube, joint": ROOM_CUBE,
            "five MPIs, joint": ROOM,
            "automatic placement, joint": JOINT,
        },
        500,
    ),
    "fern": _group("", {"automatic placement": ()}, 2000),
    "fox": _group("", {"automatic placement": ()}),
    "object": _group(  # mmpi-scene object: cameras all round it
        "",
        {
            "MPIs placed automatically": (),
        },
        1500,
    ),
    "kitti-street-budgets": _budgets(1.0, 2.0, 4.0, 8.0, 16.0),
    "room-walk-budgets": _budgets(1.0, 2.0, 4.0, 8.0, 16.0),
}

NO_VIEWS = ("--pipeline.datamanager.new-view-share", "0")
NO_DENSE = ("--pipeline.datamanager.priors.dense-depth", "False")
ABLATIONS: dict[str, list[Method]] = {
    # What the depths are worth that are found in the training images, from poses alone and beside SfM tracks.
    "depth": [
        *_group(
            "poses alone",
            {
                "poses alone, all depths": POSES_ALONE,
                "no new views": (*POSES_ALONE, *NO_VIEWS),
                "no dense depths": (*POSES_ALONE, *NO_DENSE),
                "no depth": (*POSES_ALONE, *NO_DEPTH),
            },
        ),
        *_group(
            "with SfM tracks",
            {
                "with SfM tracks, all depths": (),
                "with SfM tracks, no new views": NO_VIEWS,
                "with SfM tracks, no dense depths": NO_DENSE,
            },
        ),
    ],
    "drive": [
        *_group(  # several MPIs gain on one, reliability on them
            "the paper's ablation",
            {
                "four MPIs by hand, joint": BY_HAND,
                "one front MPI, pulled back": FRONT,
                "each alone, then reliability": (*ALONE, *SPLIT),
                "... every MPI sees all rays (30k each)": ALONE,
                "... then a joint fine-tune": (*DRIVE, *TWO_PHASE, *SPLIT, *_shares(0.1, 0.4)),
                "... a longer one, at full rates": (*DRIVE, *TWO_PHASE, *SPLIT),
                "... and every MPI sees all rays (the default)": (*DRIVE, *TWO_PHASE),
                "... with equal shares instead of reliability": (*DRIVE, *TWO_PHASE, *EQUAL_SHARES),
            },
        ),
        *_group(  # what we added or chose, one change at a time
            "changes of the reference",
            {
                "no SfM depth": (*BY_HAND, *NO_DEPTH),
            },
        ),
        *_group(
            "automatic placement",
            {
                "placed among the cameras, joint": JOINT,
                "placed, no SfM depth": (*JOINT, *NO_DEPTH),
                "placed, a tenth of the total variation": (*JOINT, *LITTLE_VARIATION),
                "placed, each alone, reliability, fine-tune": (*TWO_PHASE, *SPLIT, *_shares(0.1, 0.4)),
                "placed, two phases as by default": TWO_PHASE,
            },
        ),
    ],
    "room": [
        *_group("the paper's ablation", {"five MPIs, joint": ROOM, "five MPIs and cube, joint": ROOM_CUBE}),
        *_group("automatic placement", {"placed among the cameras, joint": JOINT}),
    ],
}
"""The first variant of each is the reference."""
