"""ScenePlan: placement and resolution of the MPIs, as plain data.

A field is built from its plan alone, so the plan is stored in the checkpoint (as JSON bytes) and beside ``config.yml``
(as a file to read and edit).
"""

from __future__ import annotations

import json
import math
from dataclasses import MISSING, asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from mmpi_ns.utils.errors import InputError, brief
from mmpi_ns.utils.values import Number, as_text, check_number, check_row, check_text

Vector = tuple[float, float, float]

SHALLOWEST = 1.001
"""Minimum ratio of the depths of an MPI's last and first plane: float32 could not distinguish closer ones."""

HUGE = 1e18
"""Maximum length in a plan, scene units: float32 can represent its square."""
LENGTH = Number(-HUGE, HUGE)
WIDEST = 1e6
"""Largest tangent of a frustum."""
MOST_PLANES, MOST_TEXELS, MOST_VOXELS, MOST_DETAIL = 4096, 16384, 4096, 64
"""Planes of an MPI, texels along a side of a plane, voxels along a side of the cube."""
FINER = 2
"""Cells of a finer copy along each side of a cell of its MPI."""
WORTH_COPIES = 3.0
"""Ratio of trainable texels to texels in use above which MPIs get finer copies: four times the texels of some bricks
are slightly too many, but those bricks have more rays than others."""


@dataclass(frozen=True)
class MPIPlan:
    """One multi-plane image. Lengths are in scene units, angles as tangents, axes are x right, y down, z facing."""

    name: str
    """Shown in the viewer and in tables."""
    origin: Vector
    """Centre of projection, world axes."""
    axes: tuple[Vector, Vector, Vector]
    """Rows are the frame's x, y and z (facing) axes in world coordinates; orthonormal, right-handed."""
    near: float
    """Depth of the nearest plane; the planes are evenly spaced in disparity from there to ``far``."""
    extent: tuple[float, float, float, float]
    """Frustum as tangents (u0, u1, v0, v1); may be asymmetric."""
    planes: int
    """Number of planes, the last one at ``far``."""
    height: int
    """Texel rows of a plane."""
    width: int
    """Texel columns of a plane."""
    far: float = math.inf
    """Depth of the last plane; inf (in JSON: null) for an MPI that reaches to infinity."""

    @property
    def depth_share(self) -> float:
        """1 - near / far: the fraction of all disparities beyond the near plane that the planes span; 1 to infinity."""
        return 1.0 - self.near * (1.0 / self.far)

    @property
    def disparity_step(self) -> float:
        """Disparity between neighbouring planes, 1 / scene units."""
        return self.depth_share / (self.near * (self.planes - 1))

    @property
    def texel_tangent(self) -> float:
        """Tangent, seen from the origin, between neighbouring rows or columns, whichever are closer."""
        u0, u1, v0, v1 = self.extent
        return min((u1 - u0) / (self.width - 1), (v1 - v0) / (self.height - 1))

    @property
    def texels(self) -> int:
        return self.planes * self.height * self.width


@dataclass(frozen=True)
class CubePlan:
    """The centred voxel grid (paper sec. III-D): an axis-aligned box in world coordinates."""

    lower: Vector
    upper: Vector
    shape: tuple[int, int, int]
    """Voxels along z, y and x (the memory order of the grid)."""

    @property
    def texels(self) -> int:
        return self.shape[0] * self.shape[1] * self.shape[2]


@dataclass(frozen=True)
class ScenePlan:
    """All MPIs of a scene, the optional cube, and the two distances that training needs."""

    mpis: tuple[MPIPlan, ...]
    cube: CubePlan | None
    ray_near: float
    """Rays start at this distance: nothing is sampled closer to a camera."""
    content_near: float
    """Distance from the cameras to the first content: an MPI entered later covers a ray only in part."""
    origin_of_plan: str = "by hand"
    """The rule that made the plan, for information."""
    detail: float = 1.0
    """Maximum texels that training may use, as a multiple of the plan's: in the room of released bricks it refines
    planes and copies bricks with large errors at a finer resolution."""

    def __post_init__(self) -> None:
        """Check of all fields. Raises InputError that names the MPI and the unusable field."""
        if not self.mpis:
            raise InputError("A scene plan needs at least one MPI, this one has none: add one to its list 'mpis'.")
        for number, mpi in enumerate(self.mpis):
            where = _mpi_name(mpi, number)
            check_text(f"The name of {where}", mpi.name)
            check_row(f"The 'origin' of {where}", mpi.origin, 3, LENGTH)
            check_number(f"The 'near' of {where}", mpi.near, Number(1 / HUGE, HUGE))
            check_row(f"The 'extent' of {where}", mpi.extent, 4, Number(-WIDEST, WIDEST))
            for name, most in (("planes", MOST_PLANES), ("height", MOST_TEXELS), ("width", MOST_TEXELS)):
                check_number(f"The '{name}' of {where}", getattr(mpi, name), Number(2, most, whole=True))
            if not isinstance(mpi.axes, (list, tuple)) or len(mpi.axes) != 3:
                raise InputError(f"The 'axes' of {where} must be three rows of three numbers, not {as_text(mpi.axes)}.")
            for i, row in enumerate(mpi.axes):
                check_row(f"Row {i + 1} of the 'axes' of {where}", row, 3, Number(-2, 2))
            axes = np.array(mpi.axes)
            if np.abs(axes @ axes.T - np.eye(3)).max() > 1e-4 or np.linalg.det(axes) < 0:
                raise InputError(
                    f"The axes of {where} are no rotation: give three perpendicular unit rows, right, down, facing."
                )
            u0, u1, v0, v1 = mpi.extent
            if u0 >= u1 or v0 >= v1:
                raise InputError(f"{where} needs an 'extent' (u0, u1, v0, v1) with u0 < u1 and v0 < v1.")
            far = mpi.far
            if far != math.inf and not Number(SHALLOWEST * mpi.near, HUGE).holds(far):
                raise InputError(
                    f"{where} needs a 'far' beyond its 'near', or null in 'far' for infinity, not {as_text(far)}."
                )
        if self.cube is not None:
            for name in ("lower", "upper"):
                check_row(f"The '{name}' of the plan's cube", getattr(self.cube, name), 3, LENGTH)
            check_row("The 'shape' of the plan's cube", self.cube.shape, 3, Number(2, MOST_VOXELS, whole=True))
            if not all(a < b for a, b in zip(self.cube.lower, self.cube.upper, strict=True)):
                raise InputError("The plan's cube needs 'upper' > 'lower' on every axis.")
        check_number("The plan's 'ray_near'", self.ray_near, Number(0, HUGE))
        check_number("The plan's 'content_near'", self.content_near, Number(0, HUGE))
        check_text("The plan's 'origin_of_plan'", self.origin_of_plan)
        check_number("The plan's 'detail'", self.detail, Number(1, MOST_DETAIL))

    @property
    def num_heads(self) -> int:
        return len(self.mpis) + (self.cube is not None)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(m.name for m in self.mpis) + (("cube",) if self.cube is not None else ())

    @property
    def texels(self) -> int:
        return sum(m.texels for m in self.mpis) + (self.cube.texels if self.cube else 0)

    @property
    def samples_per_ray(self) -> int:
        """Maximum samples of a ray: every plane, and about as many as possible in the cube."""
        return sum(m.planes for m in self.mpis) + (sum(self.cube.shape) if self.cube else 0)

    @property
    def farthest(self) -> float:
        """Depth that stands for infinity in images: ten times that of the farthest finite plane."""
        return 10 * max(m.near * (m.planes - 1) if m.far == math.inf else m.far for m in self.mpis)

    def scaled(self, factor: float) -> ScenePlan:
        """The plan at another resolution: ``factor`` times the texels, equal frames, planes and ratios of sides."""
        if factor == 1:
            return self
        side, cube = math.sqrt(factor), self.cube
        sizes = [{name: max(2, round(getattr(m, name) * side)) for name in ("height", "width")} for m in self.mpis]
        if cube is not None:
            nz, ny, nx = (max(2, round(n * factor ** (1 / 3))) for n in cube.shape)
            cube = replace(cube, shape=(nz, ny, nx))
        return replace(self, mpis=tuple(replace(m, **s) for m, s in zip(self.mpis, sizes, strict=True)), cube=cube)

    def with_copies(self) -> ScenePlan:
        """The plan with a copy of each MPI, in the same order before all MPIs: equal frame and planes, FINER times as
        many cells along each side. At equal distances a copy comes first."""
        copies = (
            replace(m, name=f"{m.name}, finer", height=FINER * (m.height - 1) + 1, width=FINER * (m.width - 1) + 1)
            for m in self.mpis
        )
        return replace(self, mpis=(*copies, *self.mpis))

    def may_be_copied(self, factor: float = 1.0) -> bool:
        """Whether the rays suffice to train finer copies of planes with ``factor`` times the planned texels, and plans
        of that size are allowed."""
        longest = max(side for m in self.scaled(factor).mpis for side in (m.height, m.width))
        return self.detail >= WORTH_COPIES * factor and FINER * longest <= MOST_TEXELS

    @property
    def largest(self) -> ScenePlan:
        """The plan with all heads that training may add."""
        return self.with_copies() if self.may_be_copied() else self

    def to_json(self) -> str:
        """Standard JSON: a ``far`` at infinity is written as null."""
        data = asdict(self)
        for mpi in data["mpis"]:
            mpi["far"] = None if mpi["far"] == math.inf else mpi["far"]
        return json.dumps(data, indent=1, allow_nan=False)

    @staticmethod
    def from_json(text: str) -> ScenePlan:
        """Reads what ``to_json`` wrote. Raises InputError naming the field that is missing, unknown or unusable."""
        return ScenePlan.from_object(read_object(text))

    @staticmethod
    def from_object(data: Any) -> ScenePlan:
        """The plan that a JSON object describes. Raises as ``from_json``."""
        check_fields(ScenePlan, data, "The scene plan")
        if not isinstance(data["mpis"], list):
            raise InputError("The scene plan's 'mpis' is not a list: compare it with docs/placement.md.")
        mpis = []
        for i, row in enumerate(data["mpis"]):
            check_fields(MPIPlan, row, _mpi_name(row, i))
            far = math.inf if row.get("far") is None else row["far"]
            mpis.append(MPIPlan(**{**_tuples(row), "far": far}))
        cube = data["cube"]
        if cube is not None:
            check_fields(CubePlan, cube, "The plan's cube")
            cube = CubePlan(**_tuples(cube))
        return ScenePlan(**{**data, "mpis": tuple(mpis), "cube": cube})


def _mpi_name(mpi: Any, index: int) -> str:
    name = mpi.get("name") if isinstance(mpi, dict) else getattr(mpi, "name", None)
    return f"MPI {as_text(name)}" if isinstance(name, str) and name else f"MPI number {index + 1}"


def read_object(text: str) -> Any:
    """The JSON of a plan. Raises InputError if it is none."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"The scene plan is not valid JSON ({brief(error)}): fix it or leave it out.") from error
    return data


def check_fields(cls: type, data: Any, where: str) -> None:
    """Raises InputError if ``data`` is not a JSON object with the fields of a class."""
    if not isinstance(data, dict):
        raise InputError(f"{where} is not a JSON object: compare it with docs/placement.md.")
    names = {f.name for f in fields(cls)}
    optional = {f.name for f in fields(cls) if f.default is not MISSING}
    unknown, missing = set(data) - names, names - set(data) - optional
    if unknown or missing:
        wrong = f"lacks {sorted(missing)}" if missing else f"has unknown fields {as_text(sorted(unknown))}"
        raise InputError(f"{where} {wrong}: compare it with docs/placement.md.")


def _tuples(value: Any) -> Any:
    """A JSON value with tuples in place of lists."""
    if isinstance(value, dict):
        return {name: _tuples(v) for name, v in value.items()}
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


_AXES = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
NO_PLAN = ScenePlan((MPIPlan("none", (0.0, 0.0, 0.0), _AXES, 1.0, (-1.0, 1.0, -1.0, 1.0), 2, 2, 2),), None, 0.0, 1.0)
"""The plan of a model that will load a checkpoint, which has its own plan."""
