"""Datasets of episodes and labelled pictures: schemas, readers, writers, verification, exports.

The state files of `knotgym.states` are re-exported here. The names below are imported when first
used.
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
    from knotgym.datasets.subsets import delete, select, split
    from knotgym.datasets.trajectory import Episode, InvalidEpisode, relabel_all, relabelled
    from knotgym.datasets.verification import faults, verify
    from knotgym.states.state_file import (
        InvalidStates,
        States,
        merge_states,
        read_states,
        shipped,
        write_states,
    )
else:
    from knotgym.common.lazy_exports import lazy_exports

    __getattr__, __dir__ = lazy_exports(__name__, __file__)

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
    "delete",
    "faults",
    "merge_states",
    "publish",
    "read_rows",
    "read_states",
    "read_table",
    "relabel_all",
    "relabelled",
    "select",
    "shipped",
    "show_episodes",
    "split",
    "verify",
    "verify_episodes",
    "write_states",
]
