"""Learners: one from pictures, which plans; a clone of macro-actions; a reader. They need torch."""

from knotgym.common.lazy_exports import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "CloneConfig": "knotgym.learn.train_config",
        "ClonePolicy": "knotgym.learn.clone_policy",
        "PicturePolicy": "knotgym.learn.picture_policy",
        "ReaderConfig": "knotgym.learn.train_config",
        "RopeReader": "knotgym.learn.rope_reader",
        "load_clone": "knotgym.learn.clone_policy",
        "load_picture_policy": "knotgym.learn.picture_policy",
        "load_rope_reader": "knotgym.learn.rope_reader",
        "train": "knotgym.learn.train_recipe",
    },
)
