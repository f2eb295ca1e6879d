"""Writing a page: template, style, script and data in one file that asks no network for anything.

The data stand in a block of JSON, where nothing ends the block and nothing is markup; the script
shows them as text only.
"""

from __future__ import annotations

import html
import json
import os
from collections.abc import Mapping
from importlib.resources import files
from string import Template
from typing import Any

from knotgym.common.atomic_files import atomic_write

_SCRIPTS = ("rope.js", "plots.js", "page.js")


def write_page(out: str | os.PathLike[str], data: Mapping[str, Any]) -> None:
    """Write the page of such data, see `page_data`, whole or not at all."""
    text = page_html(data)
    with atomic_write(out) as temporary:
        temporary.write_text(text, encoding="utf-8")


def page_html(data: Mapping[str, Any]) -> str:
    """The page of such data."""
    script = "\n".join(_part(name) for name in _SCRIPTS)
    start = 'const DATA = JSON.parse(document.getElementById("data").textContent);'
    return Template(_part("page.html")).substitute(
        title=html.escape(str(data["title"])),
        style=_part("page.css"),
        data=_as_text(data),
        script=f'(() => {{\n"use strict";\n{start}\n{script}\n}})();',
    )


def _as_text(data: Mapping[str, Any]) -> str:
    """JSON without a character that HTML gives a meaning to."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _part(name: str) -> str:
    return (files("knotgym.datasets.page") / name).read_text(encoding="utf-8")
