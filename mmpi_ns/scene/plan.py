"""ScenePlan: where the MPIs stand and what they spend texels on, as plain data.

A plan is all that a field needs to be built, so it travels inside the checkpoint (as JSON bytes) and beside
``config.yml`` (as a file that a person can read and edit).
"""

from __future__ import annotations

import json
import math
from dataclasses import MISSING, asdict, dataclass, fields, replace
from numbers import Real
from pathlib import Path

Vector = tuple[float, float, float]

SHALLOWEST = 1.001
"""An MPI's last plane lies at least so many times as deep as its first: closer, float32 could not tell them apart."""


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
    """Frustum as tangents (u0, u1, v0, v1); asymmetric is fine."""
    planes: int
    """Number of planes, the last one at ``far``."""
    height: int
    """Texel rows of a plane."""
    width: int
    """Texel columns of a plane."""
    far: float = math.inf
    """Depth of the last plane; inf (in JSON: null) for an MPI that reaches to infinity."""

    @property
    def last_disparity(self) -> float:
        """1 / far: disparity of the last plane, 0 at infinity."""
        return 1.0 / self.far

    @property
    def depth_share(self) -> float:
        """1 - near / far: the share of all disparities beyond the near plane that the planes span; 1 to infinity."""
        return 1.0 - self.near * self.last_disparity

    @property
    def disparity_step(self) -> float:
        """Disparity between neighbouring planes, 1 / scene units."""
        return self.depth_share / (self.near * (self.planes - 1))

    @property
    def farthest(self) -> float:
        """Depth of the last plane that is not at infinity."""
        return self.near * (self.planes - 1) if self.far == math.inf else self.far

    @property
    def texels(self) -> int:
        return self.planes * self.height * self.width

    def scaled(self, factor: float) -> MPIPlan:
        """The same frame with ``factor`` times the texels a plane (both sides keep their ratio)."""
        side = math.sqrt(factor)
        return replace(self, height=max(2, round(self.height * side)), width=max(2, round(self.width * side)))


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

    def scaled(self, factor: float) -> CubePlan:
        side = factor ** (1 / 3)
        nz, ny, nx = (max(2, round(n * side)) for n in self.shape)
        return replace(self, shape=(nz, ny, nx))


@dataclass(frozen=True)
class ScenePlan:
    """All MPIs of a scene, the optional cube, and the two distances that training needs."""

    mpis: tuple[MPIPlan, ...]
    cube: CubePlan | None
    ray_near: float
    """Rays start here: nothing is sampled closer to a camera than this."""
    content_near: float
    """Distance from the cameras to the first content: an MPI entered later than this explains a ray only in part."""
    origin_of_plan: str = "by hand"
    """Which rule made the plan, for the reader."""

    def __post_init__(self) -> None:
        self.validate()

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
        """Samples of a ray that crosses every plane, and about as many of the cube as it can have."""
        return sum(m.planes for m in self.mpis) + (sum(self.cube.shape) if self.cube else 0)

    def scaled(self, factor: float) -> ScenePlan:
        """The plan at another resolution: ``factor`` times the texels, equal frames and planes."""
        if factor == 1:
            return self
        cube = self.cube.scaled(factor) if self.cube else None
        return replace(self, mpis=tuple(m.scaled(factor) for m in self.mpis), cube=cube)

    def validate(self) -> None:
        """Raises ValueError with one sentence that names the MPI and the field that cannot be used."""
        if not self.mpis:
            raise ValueError("A scene plan needs at least one MPI, this one has none: add one to its list 'mpis'.")
        for mpi in self.mpis:
            _validate_mpi(mpi)
        if self.cube is not None:
            sides = [b - a for a, b in zip(self.cube.lower, self.cube.upper, strict=True)]
            if not all(math.isfinite(s) and s > 0 for s in sides) or min(self.cube.shape) < 2:
                raise ValueError("The plan's cube needs upper > lower on every axis and at least 2 voxels a side.")
        if not (math.isfinite(self.ray_near) and self.ray_near >= 0 and 0 <= self.content_near < math.inf):
            raise ValueError("The plan's ray_near and content_near must be finite and not negative.")

    def to_json(self) -> str:
        """Standard JSON: a ``far`` at infinity is written as null."""
        data = asdict(self)
        for mpi in data["mpis"]:
            mpi["far"] = None if mpi["far"] == math.inf else mpi["far"]
        return json.dumps(data, indent=1, allow_nan=False)

    @staticmethod
    def from_json(text: str) -> ScenePlan:
        """Reads what ``to_json`` wrote. Raises ValueError naming the field when a field is missing or unknown."""
        data = read_object(text)
        if not isinstance(data.get("mpis", []), list):
            raise ValueError("The scene plan's 'mpis' is not a list: compare it with docs/how_it_works.md.")
        mpis = tuple(_build(MPIPlan, _with_far(m)) for m in data.get("mpis", []))
        cube = _build(CubePlan, data["cube"]) if data.get("cube") else None
        return _build(ScenePlan, {**data, "mpis": mpis, "cube": cube})

    @staticmethod
    def load(path: Path) -> ScenePlan:
        if not path.is_file():
            raise ValueError(f"There is no scene plan at {path}: check the path given to --pipeline.model.plan-file.")
        return ScenePlan.from_json(path.read_text(encoding="utf-8"))


def _validate_mpi(mpi: MPIPlan) -> None:
    rows = {"origin": (mpi.origin, 3), "extent": (mpi.extent, 4), "near": ((mpi.near,), 1), "far": ((mpi.far,), 1)}
    rows |= {f"axes row {i}": (row, 3) for i, row in enumerate(mpi.axes)} if len(mpi.axes) == 3 else {"axes": ((), 3)}
    for field, (row, length) in rows.items():
        if len(row) != length or not all(isinstance(x, Real) for x in row):
            raise ValueError(f"MPI '{mpi.name}' of the plan needs {length} number(s) in '{field}'.")
    numbers = [*mpi.origin, *mpi.extent, mpi.near, *(x for row in mpi.axes for x in row)]
    if not all(math.isfinite(x) for x in numbers):
        raise ValueError(f"MPI '{mpi.name}' of the plan holds a number that is not finite: correct or remove it.")
    dots = [sum(a * b for a, b in zip(p, q, strict=True)) for p in mpi.axes for q in mpi.axes]
    if max(abs(d - float(i % 4 == 0)) for i, d in enumerate(dots)) > 1e-4:
        raise ValueError(f"The axes of MPI '{mpi.name}' are not orthonormal: give three perpendicular unit rows.")
    (a, b, c), (d, e, f), (g, h, i) = mpi.axes
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
        raise ValueError(
            f"The axes of MPI '{mpi.name}' are left-handed: negate one row, or give x right, y down, z facing."
        )
    if mpi.near <= 0 or mpi.extent[0] >= mpi.extent[1] or mpi.extent[2] >= mpi.extent[3]:
        raise ValueError(f"MPI '{mpi.name}' needs near > 0 and an extent (u0, u1, v0, v1) with u0 < u1 and v0 < v1.")
    if not mpi.far >= SHALLOWEST * mpi.near:
        raise ValueError(f"MPI '{mpi.name}' needs a far end beyond its near plane, or null in 'far' for infinity.")
    if mpi.planes < 2 or mpi.height < 2 or mpi.width < 2:
        raise ValueError(f"MPI '{mpi.name}' needs at least 2 planes and 2 x 2 texels.")


def read_object(text: str) -> dict:
    """The JSON object of a plan. Raises ValueError with one sentence where there is none."""
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"The scene plan is not valid JSON ({error}): fix it or leave it out.") from error
    if not isinstance(data, dict):
        raise ValueError(
            "The scene plan is not a JSON object with a list 'mpis': compare it with docs/how_it_works.md."
        )
    return data


def _build(cls, data: dict):
    if not isinstance(data, dict):
        raise ValueError(
            f"A {cls.__name__} in the scene plan is not a JSON object: compare it with docs/how_it_works.md."
        )
    names = {f.name for f in fields(cls)}
    optional = {f.name for f in fields(cls) if f.default is not MISSING}
    unknown, missing = set(data) - names, names - set(data) - optional
    if unknown or missing:
        wrong = f"lacks {sorted(missing)}" if missing else f"has unknown fields {sorted(unknown)}"
        raise ValueError(f"A {cls.__name__} in the scene plan {wrong}: compare it with docs/how_it_works.md.")
    return cls(**{k: _tuples(v) for k, v in data.items()})


def _with_far(mpi):
    """Null, or nothing as in plans of before MPIs could end, stands for infinity."""
    return {**mpi, "far": math.inf if mpi.get("far") is None else mpi["far"]} if isinstance(mpi, dict) else mpi


def _tuples(value):
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
