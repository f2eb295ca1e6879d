"""The forms that episodes can be exported to, by name."""

from __future__ import annotations

import importlib
import os
from typing import Any

from knotgym.datasets.episode_reader import Count, uncounted
from knotgym.errors import KnotgymError

# each takes a dataset, where to write, and what to tell of how far it is
FORMS = {
    "compact": "knotgym.datasets.minari_dataset:compact",
    "lerobot": "knotgym.datasets.exports.lerobot_export:to_lerobot",
    "ogbench": "knotgym.datasets.exports.ogbench_export:to_ogbench",
}


UPLOADS = ("huggingface", "minari")  # folders to upload, of several datasets at once


class UnknownForm(KnotgymError, ValueError):
    """Nothing is exported to a form of this name."""

    def __init__(self, form: str) -> None:
        super().__init__(f"no form {form!r} to export to; there is {', '.join((*FORMS, *UPLOADS))}")


class NothingToExport(KnotgymError, ValueError):
    """A dataset lacks what a form is made of."""


def export(
    source: Any,
    out: str | os.PathLike[str],
    form: str = "compact",
    count: Count = uncounted,
    *,
    overwrite: bool = False,
) -> None:
    """Write a dataset of episodes in another form.

    Args:
        source: what `EpisodeReader` takes.
        out: a file for "compact", a folder for the others.
        form: one of FORMS.
        count: told before each episode.
        overwrite: replace what exists.

    Raises:
        UnknownForm: there is no such form.
        NothingToExport: the dataset can't be put into it.
        Occupied: something exists at `out`, and `overwrite` isn't asked for.
    """
    if form not in FORMS:
        raise UnknownForm(form)
    module, _, function = FORMS[form].partition(":")
    getattr(importlib.import_module(module), function)(source, out, count, overwrite=overwrite)
