"""Datasets turned into what learners eat.

Every loader takes a dataset as a Minari id, a folder, an episode file (compact ones too), a
`minari.MinariDataset`, or the folder of a run of `knotgym generate` for its demonstrations of the
train split, and

    observation     "pixels", "state", "both" or "symbolic"; None for what the dataset's environment
                    shows
    picture         a `knotgym.rendering.picture.PictureConfig`, to draw pictures of another size,
                    camera or colours, from other views, with depth or without
    relabel         "last" or "all": hindsight, the code reached becomes the goal (see
                    `Transitions`)
    labels          True: actions are what an expert would have done, where the dataset says it
                    (`knotgym collect --labels expert`)
    cache           a folder for pictures, uncompressed, each once, made when first asked for: then
                    batches come quickly; or a `FrameCache`, which says how much it may take. The
                    pictures are the same to the byte

Torch, d3rlpy and TensorDict are imported only by the loaders that are for them; the names below
when they are first used.
"""

from typing import TYPE_CHECKING

if __name__ == "loaders":
    raise ImportError(
        "this is the link `loaders` at the top of a checkout of knotgym: import knotgym.loaders"
    )

if TYPE_CHECKING:
    from knotgym.errors import MissingExtra
    from knotgym.loaders.converters import to_d3rlpy, to_tensordict, torch_dataset
    from knotgym.loaders.frame_cache import FrameCache, NoCache
    from knotgym.loaders.perception import images
    from knotgym.loaders.rows import arrays
    from knotgym.loaders.transitions import NoLabels, Transitions
else:
    from knotgym.lazy_exports import lazy_exports

    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "FrameCache": "knotgym.loaders.frame_cache",
            "MissingExtra": "knotgym.errors",
            "NoCache": "knotgym.loaders.frame_cache",
            "NoLabels": "knotgym.loaders.transitions",
            "Transitions": "knotgym.loaders.transitions",
            "arrays": "knotgym.loaders.rows",
            "images": "knotgym.loaders.perception",
            "to_d3rlpy": "knotgym.loaders.converters",
            "to_tensordict": "knotgym.loaders.converters",
            "torch_dataset": "knotgym.loaders.converters",
        },
    )

__all__ = [
    "FrameCache",
    "MissingExtra",
    "NoCache",
    "NoLabels",
    "Transitions",
    "arrays",
    "images",
    "to_d3rlpy",
    "to_tensordict",
    "torch_dataset",
]
