"""The three kinds of data: curated states, episodes, labelled pictures; their schemas, how they are
written, read and verified, and the curated states that ship.

The names below are imported when they are first used.
"""

from typing import TYPE_CHECKING

if __name__ == "datasets":
    raise ImportError(
        "this is the link `datasets` at the top of a checkout of knotgym: import knotgym.datasets;"
        " for Hugging Face's datasets run Python from another folder, or as `python -P`"
    )

if TYPE_CHECKING:
    from knotgym.datasets.episode_reader import EpisodeReader, InvalidEpisodeFile
    from knotgym.datasets.episode_verification import show_episodes, verify_episodes
    from knotgym.datasets.episode_writer import EpisodeWriter
    from knotgym.datasets.image_table import (
        InvalidImages,
        read_rows,
        read_table,
    )
    from knotgym.datasets.minari_dataset import MinariMetadata, compact, publish
    from knotgym.datasets.states import (
        InvalidStates,
        States,
        merge_states,
        read_states,
        shipped,
        write_states,
    )
    from knotgym.datasets.trajectory import Episode, InvalidEpisode, relabel_all, relabelled
    from knotgym.datasets.verification import faults, verify
else:
    from knotgym.lazy_exports import lazy_exports

    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "Episode": "knotgym.datasets.trajectory",
            "EpisodeReader": "knotgym.datasets.episode_reader",
            "EpisodeWriter": "knotgym.datasets.episode_writer",
            "InvalidEpisode": "knotgym.datasets.trajectory",
            "InvalidEpisodeFile": "knotgym.datasets.episode_reader",
            "InvalidImages": "knotgym.datasets.image_table",
            "InvalidStates": "knotgym.datasets.states",
            "MinariMetadata": "knotgym.datasets.minari_dataset",
            "States": "knotgym.datasets.states",
            "compact": "knotgym.datasets.minari_dataset",
            "faults": "knotgym.datasets.verification",
            "merge_states": "knotgym.datasets.states",
            "publish": "knotgym.datasets.minari_dataset",
            "read_rows": "knotgym.datasets.image_table",
            "read_states": "knotgym.datasets.states",
            "read_table": "knotgym.datasets.image_table",
            "relabel_all": "knotgym.datasets.trajectory",
            "relabelled": "knotgym.datasets.trajectory",
            "shipped": "knotgym.datasets.states",
            "show_episodes": "knotgym.datasets.episode_verification",
            "verify": "knotgym.datasets.verification",
            "verify_episodes": "knotgym.datasets.episode_verification",
            "write_states": "knotgym.datasets.states",
        },
    )

__all__ = [
    "Episode",
    "EpisodeReader",
    "EpisodeWriter",
    "InvalidEpisode",
    "InvalidEpisodeFile",
    "InvalidImages",
    "InvalidStates",
    "MinariMetadata",
    "States",
    "compact",
    "faults",
    "merge_states",
    "publish",
    "read_rows",
    "read_states",
    "read_table",
    "relabel_all",
    "relabelled",
    "shipped",
    "show_episodes",
    "verify",
    "verify_episodes",
    "write_states",
]
