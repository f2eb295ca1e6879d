"""Write the page: template, style, scripts and data in one HTML file without network access.

The data are an escaped JSON block that can't contain markup; the script shows them as text only.
"""

import html
import json
from collections.abc import Mapping
from importlib.resources import files
from string import Template
from typing import Any

_SCRIPTS = ("rope.js", "plots.js", "page.js")


def page_html(data: Mapping[str, Any]) -> str:
    """Return the page of the result of `page_data`."""
    script = "\n".join(_part(name) for name in _SCRIPTS)
    start = 'const DATA = JSON.parse(document.getElementById("data").textContent);'
    return Template(_part("page.html")).substitute(
        title=html.escape(str(data["title"])),
        style=_part("page.css"),
        data=_as_text(data),
        script=f'(() => {{\n"use strict";\n{start}\n{script}\n}})();',
    )


def _as_text(data: Mapping[str, Any]) -> str:
    """Serialize to JSON without characters that are special in HTML."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _part(name: str) -> str:
    return (files("knotgym.datasets.page") / name).read_text(encoding="utf-8")
