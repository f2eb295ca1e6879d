"""A hook of MkDocs: the column of navigation from a window of 1,152 pixels on.

Material for MkDocs shows it from 76.25 em (1,220 pixels) on and has no setting for that, so the
number is replaced in the built site, in style sheets and scripts alike.
"""

from pathlib import Path
from typing import Any

# beginning of the wide layout, and the end of the narrow one just below it
_WIDTHS = {"76.25em": "72em", "76.234375em": "71.984375em", "1220px": "1152px", "1219px": "1151px"}


def on_post_build(config: Any) -> None:
    """Replace the width in the theme's own files."""
    for path in Path(config.site_dir, "assets").rglob("*"):
        if path.suffix in (".css", ".js"):
            text = before = path.read_text("utf-8")
            for theirs, ours in _WIDTHS.items():
                text = text.replace(theirs, ours)
            if text != before:
                path.write_text(text, "utf-8")
