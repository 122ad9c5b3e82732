"""When a ray ends and where its depth lies: one header, which C++, Python and the page's shader read."""

from __future__ import annotations

import re

from mmpi_ns.ops import details, ends
from mmpi_ns.rendering.details import MAX_ANGLE
from mmpi_ns.scene.geometry import FACING_EPS
from mmpi_show.web import PAGE, write_page

NUMBERS = dict(re.findall(r"const float (\w+) = (\S+);", ends.TEXT))


def test_python_reads_the_numbers_of_the_header():
    names = [name for name in NUMBERS if hasattr(ends, name)]
    assert len(names) >= 5 and all(getattr(ends, name) == float(NUMBERS[name]) for name in names)
    assert float(NUMBERS["FACING"]) == FACING_EPS


def test_the_pages_shader_has_the_header_and_no_numbers_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr("mmpi_show.web.read_header", lambda folder: {})
    page = write_page(tmp_path).read_text(encoding="utf-8")
    assert page.count(ends.TEXT) == 1
    shader = (PAGE / "march.glsl").read_text(encoding="utf-8")
    assert "is_over(light, OPAQUE_BAKED)" in shader and "is_depth(mass, expected)" in shader
    assert not re.search(rf"\b({'|'.join(NUMBERS)}) =", shader)


def test_weights_of_details_stand_in_one_header_too(tmp_path, monkeypatch):
    """Which C++, Python and the page's shader read."""
    monkeypatch.setattr("mmpi_show.web.read_header", lambda folder: {})
    page = write_page(tmp_path).read_text(encoding="utf-8")
    numbers = dict(re.findall(r"const float (\w+) = (\S+);", details.TEXT))
    assert page.count(details.TEXT) == 1 and f"const MAX_ANGLE = {MAX_ANGLE};" in page
    assert len(numbers) == 9 and all(getattr(details, name) == float(x) for name, x in numbers.items())
    shader = (PAGE / "details.glsl").read_text(encoding="utf-8")
    assert "agreement(" in shader and "faded(" in shader and not re.search(rf"\b({'|'.join(numbers)}) =", shader)
