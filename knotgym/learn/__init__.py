"""Learners: one from pictures, which plans, and a clone of macro-actions. They need torch."""

from knotgym.common.lazy_exports import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "knotgym.learn.clone_policy": "ClonePolicy load_clone",
        "knotgym.learn.picture_policy": "PicturePolicy load_picture_policy",
        "knotgym.learn.train_config": "CloneConfig ReaderConfig",
        "knotgym.learn.train_recipe": "train",
    },
)
