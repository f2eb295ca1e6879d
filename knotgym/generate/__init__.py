"""Data made: rope states (`states`), a policy's episodes, success rates and the fixed benchmark
(`episodes`), labelled pictures (`images`); what the commands do, to be called from Python.

The names below are imported when they are first used.
"""

from typing import TYPE_CHECKING

if __name__ == "generate":
    raise ImportError(
        "this is the link `generate` at the top of a checkout of knotgym: import knotgym.generate"
    )

if TYPE_CHECKING:
    from knotgym.generate.episodes.collect import CollectConfig, collect
    from knotgym.generate.episodes.evaluate import EvaluateConfig
    from knotgym.generate.episodes.evaluate import run as evaluate
    from knotgym.generate.episodes.suite import SuiteConfig, make_suite
    from knotgym.generate.images.image_recipe import make_images
    from knotgym.generate.images.images_config import ImagesConfig
    from knotgym.generate.states.generate_config import GenerateConfig
    from knotgym.generate.states.random_walk import RandomWalkConfig
    from knotgym.generate.states.random_walk_recipe import walk_states
    from knotgym.generate.states.state_recipe import generate as make_states
    from knotgym.runs.run_options import RunOptions
else:
    from knotgym.common.lazy_exports import lazy_exports

    __getattr__, __dir__, _ = lazy_exports(__name__, __file__)

__all__ = [
    "CollectConfig",
    "EvaluateConfig",
    "GenerateConfig",
    "ImagesConfig",
    "RandomWalkConfig",
    "RunOptions",
    "SuiteConfig",
    "collect",
    "evaluate",
    "make_images",
    "make_states",
    "make_suite",
    "walk_states",
]
