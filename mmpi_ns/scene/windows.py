"""Windows: parts of a long capture, each with its own MPIs, which render only the rays that start there.

The camera position of a ray determines its windows. Where balls of cameras overlap, the renderings are mixed, with
shares that change continuously along the path, so no seam is visible (Block-NeRF, Tancik et al. 2022, also mixes by
camera distance). The work for a ray or a step and the memory are those of one window, however long the capture is;
docs/how_it_works.md, "Windows".
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mmpi_ns.scene.plan import HUGE, LENGTH, ScenePlan, Vector, check_fields, read_object
from mmpi_ns.utils.errors import InputError, brief
from mmpi_ns.utils.values import Number, check_number, check_row


@dataclass(frozen=True)
class Window:
    """A ball of cameras, and its plan."""

    center: Vector
    """Centre of the ball, world axes, scene units."""
    radius: float
    """Radius of the ball, scene units; inf (in JSON: null) if there is only one window."""
    margin: float
    """Beyond the radius, the share of the window falls to zero over this distance."""
    plan: ScenePlan


@dataclass(frozen=True)
class WindowedPlan:
    """A capture's windows, in the order in which they are trained."""

    windows: tuple[Window, ...]

    def __post_init__(self) -> None:
        if not self.windows:
            raise InputError("A scene plan needs at least one window, this one has none: add one to its list.")
        if len(self.windows) == 1:
            return
        for i, w in enumerate(self.windows):
            check_row(f"The 'center' of window {i} of the plan", w.center, 3, LENGTH)
            check_number(f"The 'radius' of window {i} of the plan", w.radius, Number(0, HUGE))
            check_number(f"The 'margin' of window {i} of the plan", w.margin, Number(0, HUGE, above=True))

    def __len__(self) -> int:
        return len(self.windows)

    @property
    def plans(self) -> tuple[ScenePlan, ...]:
        return tuple(w.plan for w in self.windows)

    @property
    def texel_tangent(self) -> float:
        """Smallest distance of texels, as a tangent seen from the origin of their MPI."""
        return min(mpi.texel_tangent for plan in self.plans for mpi in plan.mpis)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all heads, window after window."""
        if len(self) == 1:
            return self.plans[0].names
        return tuple(f"window {i}: {name}" for i, plan in enumerate(self.plans) for name in plan.names)

    def find(self, name: str) -> tuple[int, int] | None:
        """Window and head of one of ``names``; None for any other name."""
        heads = [(w, head) for w, plan in enumerate(self.plans) for head in range(plan.num_heads)]
        return dict(zip(reversed(self.names), reversed(heads), strict=True)).get(name)

    @staticmethod
    def single(plan: ScenePlan) -> WindowedPlan:
        return WindowedPlan((Window((0.0, 0.0, 0.0), math.inf, 1.0, plan),))

    def to_json(self) -> str:
        """Standard JSON; a single window is written as its plan alone."""
        if len(self) == 1:
            return self.plans[0].to_json()
        rows = [
            {"center": w.center, "radius": w.radius, "margin": w.margin, "plan": json.loads(w.plan.to_json())}
            for w in self.windows
        ]
        return json.dumps({"windows": rows}, indent=1, allow_nan=False)

    @staticmethod
    def from_json(text: str) -> WindowedPlan:
        """Reads what ``to_json`` wrote. Raises InputError with one sentence about what is wrong."""
        data = read_object(text)
        if not isinstance(data, dict) or "windows" not in data:
            return WindowedPlan.single(ScenePlan.from_object(data))
        rows = data["windows"]
        if set(data) != {"windows"} or not isinstance(rows, list):
            raise InputError("A plan of several windows needs one list 'windows' and nothing else: correct it.")
        windows = []
        for i, row in enumerate(rows):
            check_fields(Window, row, f"Window {i} of the plan")
            center = tuple(row["center"]) if isinstance(row["center"], list) else row["center"]
            try:
                plan = ScenePlan.from_object(row["plan"])
            except InputError as error:
                raise InputError(f"Window {i} of the plan: {error}") from error
            windows.append(Window(center, row["radius"], row["margin"], plan))
        return WindowedPlan.single(windows[0].plan) if len(windows) == 1 else WindowedPlan(tuple(windows))

    @staticmethod
    def load(path: Path) -> WindowedPlan:
        """Reads a file. Raises InputError naming the file and what is wrong in it."""
        if not path.is_file():
            raise InputError(f"There is no scene plan at {path}: check the path given to --pipeline.model.plan-file.")
        try:
            return WindowedPlan.from_json(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path} cannot be read ({brief(error)}): save it as UTF-8 text.") from error
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


def window_shares(origins: Float[Tensor, "R 3"], windows: tuple[Window, ...]) -> Float[Tensor, "R W"]:
    """Share of each window in rays that start at ``origins``; every row sums to 1.

    Inside its ball a window has full weight, which falls off linearly over its margin beyond it; weights are
    normalised. A ray that starts in no ball uses the nearest.
    """
    centers, radii, margins = (
        torch.tensor([getattr(w, name) for w in windows], dtype=torch.float64, device=origins.device)
        for name in ("center", "radius", "margin")
    )
    beyond = (origins.double()[:, None] - centers).norm(dim=-1) - radii
    counts = (1 - beyond / margins).clamp(0, 1)
    nearest = torch.nn.functional.one_hot(beyond.argmin(-1), len(windows)).to(counts)
    counts = torch.where(counts.sum(-1, keepdim=True) > 0, counts, nearest)
    return (counts / counts.sum(-1, keepdim=True)).to(origins.dtype)


def to_bytes(text: str) -> UInt8[Tensor, "B"]:
    """Text as a buffer of a module."""
    return torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8)


def to_text(data: UInt8[Tensor, "B"]) -> str:
    """Inverse of ``to_bytes``."""
    return bytes(data.cpu().numpy().tolist()).decode()
