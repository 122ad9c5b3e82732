"""The web page of a baked scene: a folder for any static host, or one HTML file."""

from __future__ import annotations

import base64
import json
from pathlib import Path

from mmpi_ns.ops import ends
from mmpi_ns.rendering.details import MAX_ANGLE, WEIGHTS
from mmpi_ns.utils.files import write_atomically
from mmpi_show.files import HEADER

PAGE = Path(__file__).parent / "page"


def write_page(folder: Path, single_file: Path | None = None) -> None:
    """Writes the page of a baked scene into its folder, or one file that contains it and opens by a double click.

    Raises OSError if the scene is missing or the disk is full.
    """
    path = single_file or folder / "index.html"
    first, rest = [], []
    if single_file is not None:
        block, data_type = '<script type="{}" id="{}">{}</script>', "application/octet-stream"
        text = (folder / HEADER).read_text(encoding="utf-8")
        first.append(block.format("application/json", HEADER, text.replace("<", "\\u003c")))
        for row in json.loads(text)["windows"]:
            data, split = (folder / row["file"]).read_bytes(), row["first_bytes"]
            first.append(block.format(data_type, row["file"], base64.b64encode(data[:split]).decode()))
            rest.append(block.format(data_type, f"{row['file']}.rest", base64.b64encode(data[split:]).decode()))
    march, details, page, *scripts = (
        (PAGE / name).read_text(encoding="utf-8")
        for name in ("march.glsl", "details.glsl", "index.html", "scene.js", "details.js", "page.js")
    )
    shaders = {"MARCH": march.replace("ENDS", ends.TEXT, 1), "DETAILS": WEIGHTS + details}
    constants = [f"const {name} = `{text}`;" for name, text in shaders.items()] + [f"const MAX_ANGLE = {MAX_ANGLE};"]
    page = page.replace("/*code*/", "\n".join([*constants, *scripts]))
    # The code between the data runs before the rest is there.
    page = page.replace("<!--data-->", "\n".join(first)).replace("<!--rest-->", "\n".join(rest))
    write_atomically(path, lambda unfinished: unfinished.write_text(page, encoding="utf-8"))
