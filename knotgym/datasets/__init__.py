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
    from knotgym.datasets.episode_dataset import EpisodeDataset as EpisodeDataset
    from knotgym.datasets.episode_dataset import open_episodes as open_episodes
    from knotgym.datasets.episode_dataset import write_episodes as write_episodes
    from knotgym.datasets.episode_verification import show_episodes as show_episodes
    from knotgym.datasets.episodes import Episodes as Episodes
    from knotgym.datasets.episodes import goals_reached as goals_reached
    from knotgym.datasets.image_table import read_table as read_table
    from knotgym.datasets.minari_form import MinariMetadata as MinariMetadata
    from knotgym.datasets.minari_form import publish as publish
    from knotgym.datasets.subsets import delete as delete
    from knotgym.datasets.subsets import select as select
    from knotgym.datasets.subsets import split as split
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
            "knotgym.datasets.episode_dataset": "EpisodeDataset open_episodes write_episodes",
            "knotgym.datasets.episode_verification": "show_episodes",
            "knotgym.datasets.episodes": "Episodes goals_reached",
            "knotgym.datasets.image_table": "read_table",
            "knotgym.datasets.minari_form": "MinariMetadata publish",
            "knotgym.datasets.subsets": "delete select split",
            "knotgym.states.state_file": "States merge_states read_states shipped write_states",
        },
    )
