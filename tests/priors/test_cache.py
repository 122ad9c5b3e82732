"""What is found once is read afterwards, by all processes, and found anew when its images change."""

from __future__ import annotations

import os
import weakref
from concurrent.futures import ThreadPoolExecutor
from time import sleep

import numpy as np
from filelock import FileLock

from mmpi_priors import cache
from mmpi_priors.cache import digest, held, remembered


def counting(calls, delay=0.0):
    def find():
        sleep(delay)
        calls.append(1)
        return {"x": np.arange(5.0), "names": np.array(["a", "bc"], "U16")}

    return find


def test_a_result_is_found_once(tmp_path):
    calls = []
    for _ in range(3):
        found = remembered("key", counting(calls), tmp_path)
        assert found["x"].tolist() == [0, 1, 2, 3, 4] and found["names"].tolist() == ["a", "bc"]
    remembered("other", counting(calls), tmp_path)
    assert len(calls) == 2


def test_of_several_that_ask_at_once_one_finds_and_the_others_wait(tmp_path):
    calls = []
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: remembered("key", counting(calls, 0.2), tmp_path), range(4)))
    assert len(calls) == 1 and all(f["x"].tolist() == [0, 1, 2, 3, 4] for f in found)


def test_results_are_read_and_written_one_by_one(tmp_path):
    """Pairs are never held together, nor are arrays that were read; changes to them stay with the reader."""
    held = []

    def find():
        for i in range(5):
            array = np.full((300, 200), i, np.int16)
            held.append(weakref.ref(array))
            yield str(i), array
            del array
            assert sum(ref() is not None for ref in held) <= 1

    for _ in range(2):
        arrays = remembered("key", find, tmp_path)
        assert list(arrays) == [*"01234"] and len(held) == 5
        assert all((array == int(name)).all() for name, array in arrays.items())
        assert arrays["2"] is not arrays["2"]
        arrays["3"][:] = 7
        assert (arrays["3"] == 3).all()


def test_a_result_that_is_read_may_be_forgotten_meanwhile(tmp_path):
    arrays = remembered("key", counting([]), tmp_path)
    (tmp_path / "key.npz").unlink()
    assert arrays["x"].tolist() == [0, 1, 2, 3, 4]


def test_results_are_forgotten_beyond_a_size(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "MOST_BYTES", 1)
    for n in range(3):
        remembered(f"key{n}", counting([]), tmp_path)
        os.utime(tmp_path / f"key{n}.npz", (n, n))
    assert [p.name for p in tmp_path.glob("*.npz")] == ["key2.npz"]


def test_shapes_and_types_come_back(tmp_path):
    stored = {
        "a": np.zeros((0, 3)),
        "b": np.array(2.5),
        "c": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "d": [True],
    }
    arrays = remembered("key", lambda: stored, tmp_path)
    for name, array in stored.items():
        assert np.array_equal(arrays[name], array) and arrays[name].shape == np.shape(array), name


def test_a_result_that_is_being_computed_is_not_forgotten(tmp_path, monkeypatch):
    """Its lock would be removed under the hands of those who wait for it."""
    monkeypatch.setattr(cache, "KEPT", 0)
    for name in ("held", "free"):
        (tmp_path / f"{name}.npz").write_bytes(b"")
    with FileLock(tmp_path / "held.lock"):
        remembered("own", lambda: {"x": np.zeros(1)}, tmp_path)
        assert {p.name for p in tmp_path.glob("*.*")} == {"held.lock", "held.npz", "own.lock", "own.npz"}


def test_what_a_killed_process_left_half_written_is_cleared_away(tmp_path):
    (tmp_path / ".key.npz.77.tmp").write_bytes(b"half a file")
    remembered("key", counting([]), tmp_path)
    assert not list(tmp_path.glob(".*"))


def test_a_damaged_file_is_found_anew(tmp_path):
    calls = []
    remembered("key", counting(calls), tmp_path)
    (tmp_path / "key.npz").write_bytes(b"half a file")
    assert remembered("key", counting(calls), tmp_path)["x"].tolist() == [0, 1, 2, 3, 4] and len(calls) == 2


def test_where_nothing_can_be_written_it_is_found_and_said(tmp_path, capsys):
    calls = []
    (tmp_path / "file").write_text("")
    assert remembered("key", counting(calls), tmp_path / "file/cache")["x"].tolist() == [0, 1, 2, 3, 4]
    assert calls == [1] and "recomputed" in capsys.readouterr().out


def test_the_oldest_are_forgotten(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "KEPT", 2)
    for n in range(4):
        remembered(f"key{n}", counting([]), tmp_path)
        for m in range(n + 1):
            if (tmp_path / f"key{m}.npz").exists():
                os.utime(tmp_path / f"key{m}.npz", (m, m))
    assert sorted(p.name for p in tmp_path.glob("*.npz")) == ["key2.npz", "key3.npz"]


def test_keys_tell_files_poses_and_settings_apart(tmp_path):
    file, poses = tmp_path / "a.png", np.eye(4)
    file.write_text("one")
    key = digest([file], "tracks", 1, poses)
    assert key == digest([file], "tracks", 1, poses.copy())
    others = [digest([file], "tracks", 2, poses), digest([file], "tracks", 1, poses + 1e-12), digest([], "tracks", 1)]
    file.write_text("other")
    others.append(digest([file], "tracks", 1, poses))
    assert key not in others and len(set(others)) == 4


def images_held(sizes, bytes_of_pixel, least):
    """Images whose results are still there after 40 have been asked for."""
    calls = []
    result = held(lambda i: calls.append(i) or 2 * i, np.array(sizes), bytes_of_pixel, least)
    assert [result(i) for i in range(40)] == list(range(0, 80, 2)) and len(calls) == 40
    for i in reversed(range(40)):
        result(i)
        if len(calls) > 40:
            return 39 - i
    return 40


def test_of_large_images_few_are_held_but_as_many_as_are_compared():
    sizes = [[960.0, 540.0], [10.0, 10.0]]
    assert images_held(sizes, 17, 7) == 2**28 // (17 * 960 * 540) == 30
    assert images_held(sizes, 12, 7) == images_held(sizes[1:], 12, 7) == 32
    assert images_held([[4000.0, 3000.0]], 17, 7) == 7


def test_threads_that_ask_for_one_image_at_once_share_one_call():
    calls = []
    result = held(lambda i: sleep(0.05) or calls.append(i) or i, np.array([[10.0, 10.0]]), 1, 4)
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(result, [0, 0, 1, 1, 0, 2])) == [0, 0, 1, 1, 0, 2]
    assert sorted(calls) == [0, 1, 2]
