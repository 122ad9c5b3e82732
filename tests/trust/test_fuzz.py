"""Files with random mistakes: a sentence or a run, never a traceback, never more than 2 GB."""

from __future__ import annotations

import copy
import json
import math
import os
import tempfile
from pathlib import Path

import pytest
from forked import call
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

MUTATIONS = 500
"""Of each kind of file."""
MEMORY = 2 << 30
JUNK = st.one_of(
    st.sampled_from(
        [
            None, True, False, "", "x", "NaN", "64", "\0", "a" * 1000, -1, 0, 1, 2, 64.5, 1e-300, 1e9, 1e18, 1e300,
            -1e300, math.nan, math.inf, -math.inf, 10**30, 10**400, [], {}, [[]], [None] * 4, [1e308] * 4,
        ]
    ),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
)  # fmt: skip


@st.composite
def mistaken(draw, document):
    """A JSON document in which one to three values are replaced, removed or doubled."""
    document = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 3))):
        node = document
        while isinstance(node, (dict, list)) and node:
            keys = sorted(node) if isinstance(node, dict) else range(len(node))
            key = draw(st.sampled_from(keys))
            if not isinstance(node[key], (dict, list)) or not node[key] or draw(st.integers(0, 4)) == 0:
                how = draw(st.sampled_from(["replace", "replace", "replace", "remove", "double"]))
                if how == "remove":
                    del node[key]
                elif how == "double" and isinstance(node, list):
                    node.insert(key, copy.deepcopy(node[key]))
                else:
                    node[key] = copy.deepcopy(draw(JUNK))
                break
            node = node[key]
    return document


def is_sentence(error):
    said = str(error)
    return said.endswith(".") and ". " not in said and "\n" not in said and len(said) < 600


def tried(document, use):
    """Uses so many mistaken copies of a document; returns how many were refused."""
    from mmpi_ns.utils.errors import InputError

    refused = []

    @settings(max_examples=MUTATIONS, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(mistaken(document))
    def attempt(changed):
        try:
            use(json.dumps(changed))
        except InputError as error:
            assert is_sentence(error), error
            refused.append(str(error))

    attempt()
    return len(refused)


def use_capture(folder):
    """Reads a transforms.json as ns-train does, up to the cameras that placement is given."""
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    from mmpi_ns.data.checks import check_transforms
    from mmpi_priors.observe import read_observations

    def use(text):
        (folder / "transforms.json").write_text(text)
        parser = NerfstudioDataParserConfig(data=folder, downscale_factor=1)
        check_transforms(parser, folder, ("train", "val"), opens=True)
        outputs = parser.setup().get_dataparser_outputs("train")
        read_observations(outputs, outputs.cameras, None)

    return use


def use_plan(folder):
    """Reads a plan, and builds the field of one that is small enough."""
    from mmpi_ns.field.mmpi_field import MMPIField
    from mmpi_ns.scene.windows import WindowedPlan
    from mmpi_ns.training.memory import Work, fit_memory

    def use(text):
        (folder / "plan.json").write_text(text)
        windows = WindowedPlan.load(folder / "plan.json")
        fit_memory(windows, lambda window: None, Work(9, False), "cpu")
        if windows.plans[0].texels < 1e5:
            MMPIField(windows.plans[0], shading="ray")

    return use


def fuzz(kind, text):
    folder = Path(tempfile.mkdtemp(dir=os.environ["XDG_CACHE_HOME"]))
    refused = tried(json.loads(text), use_capture(folder) if kind == "capture" else use_plan(folder))
    print(f"refused {refused}")


@pytest.mark.parametrize("kind", ["capture", "plan"])
def test_random_mistakes_end_in_a_sentence_or_a_run(whole_scene, tmp_path, kind):
    from training_runs import write_plan

    plan = write_plan(whole_scene, tmp_path / "plan.json", with_cube=True)
    text = (whole_scene / "transforms.json" if kind == "capture" else plan).read_text()
    ended = call(fuzz, kind, text, memory=MEMORY)
    assert ended.status == 0, ended.error[-4000:]
    refused = int(ended.out.split("refused ")[-1])
    assert MUTATIONS // 4 < refused < MUTATIONS  # some go through
