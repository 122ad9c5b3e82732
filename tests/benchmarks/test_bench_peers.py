"""What nerfstudio's methods are given by the harness: quick hash lookups, point clouds, and runs that go on."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import peers
import pytest
import torch
from nerfstudio.field_components.encodings import HashEncoding
from peers import parser_points
from trainings import Progress

from mmpi_ns.ops import dispatch


@pytest.mark.parametrize("native_or_torch", ["auto", "torch"])
@pytest.mark.parametrize(("levels", "size"), [(5, 8), (16, 12)])
def test_quick_hash_lookups_are_nerfstudios_own(levels, size, native_or_torch, monkeypatch):
    monkeypatch.setattr(dispatch, "_chosen", native_or_torch)
    torch.manual_seed(0)
    encoding = HashEncoding(levels, 16, 512, size, implementation="torch")
    positions = torch.rand(7, 300, 3)
    positions[0] = (positions[0] * 16).round() / 16  # on the corners of cells, where both ends are one
    positions[1, 0], positions[1, 1] = 0, 1
    upstream = torch.randn(7, 300, 2 * levels)
    found = []
    for look_up in (HashEncoding.pytorch_fwd, peers.hash_lookups):
        encoding.zero_grad()
        features = look_up(encoding, positions)
        features.backward(upstream)
        assert encoding.hash_table.grad is not None
        found.append((features.detach(), encoding.hash_table.grad.clone()))
    scale = float(encoding.hash_table.abs().max())
    torch.testing.assert_close(found[1][0], found[0][0], rtol=0, atol=1e-6 * scale)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-5, atol=1e-4)
    assert float(found[0][1].abs().max()) > 1


def test_what_a_run_goes_on_from_was_asked_for_in_the_same_words(tmp_path):
    words = ("nerfacto", "--max-num-iterations", "5", "--machine.seed", "0")
    own = [*words[:2], *words[3:]]
    kept = Progress(own, [{"step": 1, "seconds": 2.0}, {"step": 2, "seconds": 3.5}], 128, 1.5)
    saved = tmp_path / "step-000000001.ckpt"
    steps = []
    kept.save(SimpleNamespace(save_checkpoint=steps.append, checkpoint_dir=tmp_path), tmp_path)
    assert steps == [1] and Progress.before(words, tmp_path, 5).last["step"] == 0, (
        "the trainer names checkpoints by this"
    )
    saved.touch()
    assert Progress.before(words, tmp_path, 5) == kept and (kept.last["step"], kept.last["seconds"]) == (2, 3.5)
    assert Progress.before((*words[:2], "9", *words[3:]), tmp_path, 9) == kept
    assert Progress.before((*words[:4], "1"), tmp_path, 5).last["step"] == 0, "another seed"
    assert Progress.before(words, tmp_path, 2).last["step"] == 0, "a run as long has nothing to add"
    assert Progress.before(words, tmp_path / "elsewhere", 5) == Progress(own)
    saved.unlink()
    assert Progress.before(words, tmp_path, 5).last["step"] == 0, "its checkpoint is gone"


def test_point_clouds_are_read_without_open3d(tmp_path):
    head = ["ply", "format {}", "element vertex 2", "property float x", "property float y", "property float z"]
    head += ["property uchar red", "property uchar green", "property uchar blue", "end_header", ""]
    rows = [(1.5, -2.0, 3.25, 10, 20, 30), (0.5, 4.0, -1.0, 255, 0, 7)]
    text = tmp_path / "text.ply"
    text.write_text("\n".join(head).format("ascii 1.0") + "\n".join(" ".join(map(str, r)) for r in rows) + "\n")
    kind = np.dtype([(n, "<f4") for n in "xyz"] + [(n, "u1") for n in "rgb"])
    binary = tmp_path / "binary.ply"
    binary.write_bytes("\n".join(head).format("binary_little_endian 1.0").encode() + np.array(rows, kind).tobytes())
    for path in (text, binary):
        xyz, rgb = parser_points(path, torch.eye(4)[:3], 1.0).values()
        assert xyz.tolist() == [list(r[:3]) for r in rows] and rgb.tolist() == [list(r[3:]) for r in rows]


def test_points_are_where_nerfstudio_puts_them(tmp_path, monkeypatch):
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio

    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(7, 3)).astype(np.float32), rng.integers(0, 256, (7, 3))
    kinds = [f"property float {c}" for c in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    rows = [" ".join(map(str, [*p, *c])) for p, c in zip(xyz.tolist(), rgb.tolist(), strict=True)]
    cloud = tmp_path / "cloud.ply"
    cloud.write_text("\n".join(["ply", "format ascii 1.0", "element vertex 7", *kinds, "end_header", *rows, ""]))
    # What open3d would have read, in its units.
    known = SimpleNamespace(points=xyz.astype(np.float64), colors=(rgb + 0.5) / 255)
    open3d = SimpleNamespace(io=SimpleNamespace(read_point_cloud=lambda path: known))
    monkeypatch.setitem(sys.modules, "open3d", open3d)  # type: ignore[arg-type]
    given = (None, cloud, torch.randn(3, 4), 0.3)
    wanted = Nerfstudio._load_3D_points(*given)  # type: ignore[arg-type]
    monkeypatch.setattr(Nerfstudio, "_load_3D_points", None)  # restored afterwards
    peers.read_points_ourselves()
    found = Nerfstudio._load_3D_points(*given)  # type: ignore[arg-type]
    assert wanted is not None and found is not None
    assert torch.allclose(found["points3D_xyz"], wanted["points3D_xyz"], atol=1e-6)
    assert torch.equal(found["points3D_rgb"], wanted["points3D_rgb"])
    cloud.write_text("\n".join(["ply", "format ascii 1.0", "element vertex 0", *kinds, "end_header", ""]))
    assert Nerfstudio._load_3D_points(*given) is None  # type: ignore[arg-type]
