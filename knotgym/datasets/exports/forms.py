"""Formats that episodes can be exported to, by name."""

import importlib
import os
from typing import Any

from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_reader import Count, uncounted

# format -> function(dataset, output path, progress callback, overwrite=)
FORMS = {
    "compact": "knotgym.datasets.minari_dataset:compact",
    "lerobot": "knotgym.datasets.exports.lerobot_export:to_lerobot",
    "ogbench": "knotgym.datasets.exports.ogbench_export:to_ogbench",
}
UPLOADS = ("huggingface", "minari")  # repository folders, of several datasets at once


def export(
    source: Any,
    out: str | os.PathLike[str],
    form: str = "compact",
    count: Count = uncounted,
    *,
    overwrite: bool = False,
    video: str = "",
) -> None:
    """Write a dataset of episodes in another format.

    Args:
        source: what `EpisodeReader` takes.
        out: a file for "compact", a folder for the others.
        form: the format, one of FORMS.
        video: "h264" or "av1" for the pictures of format lerobot as video; PNG by default.

    Raises:
        InvalidInput: there is no such format, or the dataset can't be stored in it.
        Occupied: something exists at `out`, and `overwrite` is False.
    """
    if form not in FORMS:
        formats = ", ".join((*FORMS, *UPLOADS))
        raise InvalidInput(f"no format {form!r}; formats are {formats}")
    if video and form != "lerobot":
        raise InvalidInput(f"format {form} has no video, got {video!r}; lerobot has")
    module, _, function = FORMS[form].partition(":")
    options = {"video": video} if video else {}
    to = getattr(importlib.import_module(module), function)
    to(source, out, count, overwrite=overwrite, **options)
