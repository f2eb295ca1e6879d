"""Datasets turned into what learners eat.

Every loader takes a dataset as a Minari id, a folder, an episode file (compact ones too) or a
`minari.MinariDataset`, and

    observation     "pixels", "state" or "both"; None for what the dataset's environment shows
    picture         a `knotgym.rendering.picture.PictureConfig`, to draw pictures of another size,
                    camera or colours
    relabel         "last" or "all": hindsight, the code reached becomes the goal (see
                    `Transitions`)

Torch, d3rlpy and TensorDict are imported only by the loaders that are for them.
"""

from knotgym.loaders.converters import MissingExtra, to_d3rlpy, to_tensordict, torch_dataset
from knotgym.loaders.perception import images
from knotgym.loaders.rows import arrays
from knotgym.loaders.transitions import Transitions

__all__ = [
    "MissingExtra",
    "Transitions",
    "arrays",
    "images",
    "to_d3rlpy",
    "to_tensordict",
    "torch_dataset",
]
