"""What is found once is read afterwards, by all processes, and found anew when its images change."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from time import sleep

import numpy as np

from mmpi_priors.cache import digest, remembered


def counting(calls, delay=0.0):
    def find():
        sleep(delay)
        calls.append(1)
        return {"x": np.arange(5.0), "names": np.array(["a", "bc"], "U16")}

    return find


def test_a_result_is_found_once(tmp_path):
    calls = []
    for _ in range(3):
        actual = remembered("key", counting(calls), tmp_path)
        assert actual["x"].tolist() == [0, 1, 2, 3, 4] and actual["names"].tolist() == ["a", "bc"]
    remembered("other", counting(calls), tmp_path)
    assert len(calls) == 2


def test_of_several_that_ask_at_once_one_finds_and_the_others_wait(tmp_path):
    calls = []
    with ThreadPoolExecutor(4) as pool:
        actual = list(pool.map(lambda _: remembered("key", counting(calls, 0.2), tmp_path), range(4)))
    assert len(calls) == 1 and all(f["x"].tolist() == [0, 1, 2, 3, 4] for f in actual)


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


def test_keys_tell_files_poses_and_settings_apart(tmp_path):
    file, poses = tmp_path / "a.png", np.eye(4)
    file.write_text("one")
    key = digest([file], "tracks", 1, poses)
    assert key == digest([file], "tracks", 1, poses.copy())
    others = [digest([file], "tracks", 2, poses), digest([file], "tracks", 1, poses + 1e-12), digest([], "tracks", 1)]
    file.write_text("other")
    others.append(digest([file], "tracks", 1, poses))
    assert key not in others and len(set(others)) == 4
