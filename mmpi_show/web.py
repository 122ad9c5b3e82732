"""The web page of a baked scene: a folder for any static host, or one HTML file."""

from __future__ import annotations

import base64
import json
from itertools import pairwise
from pathlib import Path

from mmpi_ns.ops import ends
from mmpi_ns.ops.details import TEXT as WEIGHTS
from mmpi_ns.rendering.details import MAX_ANGLE
from mmpi_ns.utils.files import write_atomically
from mmpi_show.files import HEADER

PAGE = Path(__file__).parent / "page"


def write_page(folder: Path, single_file: Path | None = None) -> Path:
    """Writes the page of a baked scene into its folder, or one file that contains it and opens by a double click.

    Returns the file. Raises OSError if the scene is missing or the disk is full.
    """
    path = single_file or folder / "index.html"
    first, rest, last = [], [], []
    if single_file is not None:
        block = '<script type="{}" id="{}">{}</script>'
        text = (folder / HEADER).read_text(encoding="utf-8")
        first.append(block.format("application/json", HEADER, text.replace("<", "\\u003c")))
        for row in json.loads(text)["windows"]:
            data, kind = (folder / row["file"]).read_bytes(), "application/octet-stream"
            ends_of_parts = (0, row["first_bytes"], row["bricks_bytes"], row["bytes"])
            parts = [base64.b64encode(data[begin:end]).decode() for begin, end in pairwise(ends_of_parts)]
            first.append(block.format(kind, row["file"], parts[0]))
            rest.append(block.format(kind, f"{row['file']}.rest", parts[1]))
            last.append(block.format(kind, f"{row['file']}.details", parts[2]))
    march, details, page, *scripts = (
        (PAGE / name).read_text(encoding="utf-8")
        for name in ("march.glsl", "details.glsl", "index.html", "scene.js", "details.js", "page.js")
    )
    shaders = {"MARCH": march.replace("ENDS", ends.TEXT, 1), "DETAILS": WEIGHTS + details}
    constants = [f"const {name} = `{text}`;" for name, text in shaders.items()] + [f"const MAX_ANGLE = {MAX_ANGLE};"]
    page = page.replace("/*code*/", "\n".join([*constants, *scripts]))
    # The code between the data runs before the rest is there.
    page = page.replace("<!--data-->", "\n".join(first)).replace("<!--rest-->", "\n".join(rest + last))
    write_atomically(path, lambda unfinished: unfinished.write_text(page, encoding="utf-8"))
    return path
