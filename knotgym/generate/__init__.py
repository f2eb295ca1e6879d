"""Data made: curated states (`states`), a policy's episodes and success rates (`episodes`),
labelled pictures (`images`); what the commands do, to be called from Python.

The names below are imported when they are first used.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from knotgym.generate.episodes.collect import CollectConfig, InvalidCollection, collect
    from knotgym.generate.episodes.evaluate import EvaluateConfig, InvalidEvaluation
    from knotgym.generate.episodes.evaluate import run as evaluate
    from knotgym.generate.images.image_recipe import ImagesConfig, InvalidImagesJob
    from knotgym.generate.images.image_recipe import make as make_images
    from knotgym.generate.states.curation_run import GenerateConfig, InvalidJob, NotEnough
    from knotgym.generate.states.state_recipe import generate as make_states
else:
    from knotgym.lazy_exports import lazy_exports

    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "CollectConfig": "knotgym.generate.episodes.collect",
            "EvaluateConfig": "knotgym.generate.episodes.evaluate",
            "GenerateConfig": "knotgym.generate.states.curation_run",
            "ImagesConfig": "knotgym.generate.images.image_recipe",
            "InvalidCollection": "knotgym.generate.episodes.collect",
            "InvalidEvaluation": "knotgym.generate.episodes.evaluate",
            "InvalidImagesJob": "knotgym.generate.images.image_recipe",
            "InvalidJob": "knotgym.generate.states.curation_run",
            "NotEnough": "knotgym.generate.states.curation_run",
            "collect": "knotgym.generate.episodes.collect",
            "evaluate": "knotgym.generate.episodes.evaluate:run",
            "make_images": "knotgym.generate.images.image_recipe:make",
            "make_states": "knotgym.generate.states.state_recipe:generate",
        },
    )

__all__ = [
    "CollectConfig",
    "EvaluateConfig",
    "GenerateConfig",
    "ImagesConfig",
    "InvalidCollection",
    "InvalidEvaluation",
    "InvalidImagesJob",
    "InvalidJob",
    "NotEnough",
    "collect",
    "evaluate",
    "make_images",
    "make_states",
]
