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
    from knotgym.datasets.episode_reader import EpisodeReader as EpisodeReader
    from knotgym.datasets.episode_verification import show_episodes as show_episodes
    from knotgym.datasets.episode_verification import verify_episodes as verify_episodes
    from knotgym.datasets.episode_writer import EpisodeWriter as EpisodeWriter
    from knotgym.datasets.image_table import read_rows as read_rows
    from knotgym.datasets.image_table import read_table as read_table
    from knotgym.datasets.minari_dataset import MinariMetadata as MinariMetadata
    from knotgym.datasets.minari_dataset import compact as compact
    from knotgym.datasets.minari_dataset import publish as publish
    from knotgym.datasets.subsets import delete as delete
    from knotgym.datasets.subsets import select as select
    from knotgym.datasets.subsets import split as split
    from knotgym.datasets.trajectory import Episode as Episode
    from knotgym.datasets.trajectory import relabel_all as relabel_all
    from knotgym.datasets.trajectory import relabelled as relabelled
    from knotgym.datasets.verification import faults as faults
    from knotgym.datasets.verification import verify as verify
    from knotgym.states.state_file import States as States
    from knotgym.states.state_file import merge_states as merge_states
    from knotgym.states.state_file import read_states as read_states
    from knotgym.states.state_file import shipped as shipped
    from knotgym.states.state_file import write_states as write_states
else:
    from knotgym.common.lazy_exports import lazy_exports

    __getattr__, __dir__, __all__ = lazy_exports(
        __name__,
        {
            "Episode": "knotgym.datasets.trajectory",
            "EpisodeReader": "knotgym.datasets.episode_reader",
            "EpisodeWriter": "knotgym.datasets.episode_writer",
            "MinariMetadata": "knotgym.datasets.minari_dataset",
            "States": "knotgym.states.state_file",
            "compact": "knotgym.datasets.minari_dataset",
            "delete": "knotgym.datasets.subsets",
            "faults": "knotgym.datasets.verification",
            "merge_states": "knotgym.states.state_file",
            "publish": "knotgym.datasets.minari_dataset",
            "read_rows": "knotgym.datasets.image_table",
            "read_states": "knotgym.states.state_file",
            "read_table": "knotgym.datasets.image_table",
            "relabel_all": "knotgym.datasets.trajectory",
            "relabelled": "knotgym.datasets.trajectory",
            "select": "knotgym.datasets.subsets",
            "shipped": "knotgym.states.state_file",
            "show_episodes": "knotgym.datasets.episode_verification",
            "split": "knotgym.datasets.subsets",
            "verify": "knotgym.datasets.verification",
            "verify_episodes": "knotgym.datasets.episode_verification",
            "write_states": "knotgym.states.state_file",
        },
    )
