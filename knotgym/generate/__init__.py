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
    from knotgym.generate.episodes.collect import collect as collect
    from knotgym.generate.episodes.collect_config import CollectConfig as CollectConfig
    from knotgym.generate.episodes.evaluate import run as evaluate  # noqa: F401
    from knotgym.generate.episodes.evaluate_config import EvaluateConfig as EvaluateConfig
    from knotgym.generate.episodes.suite import make_suite as make_suite
    from knotgym.generate.episodes.suite_config import SuiteConfig as SuiteConfig
    from knotgym.generate.images.image_recipe import make_images as make_images
    from knotgym.generate.images.images_config import ImagesConfig as ImagesConfig
    from knotgym.generate.states.generate_config import GenerateConfig as GenerateConfig
    from knotgym.generate.states.state_recipe import make_states as make_states
    from knotgym.runs.run_options import RunOptions as RunOptions
else:
    from knotgym.common.lazy_exports import lazy_exports

    __getattr__, __dir__, __all__ = lazy_exports(
        __name__,
        {
            "knotgym.generate.episodes.collect": "collect",
            "knotgym.generate.episodes.collect_config": "CollectConfig",
            "knotgym.generate.episodes.evaluate": "evaluate=run",
            "knotgym.generate.episodes.evaluate_config": "EvaluateConfig",
            "knotgym.generate.episodes.suite": "make_suite",
            "knotgym.generate.episodes.suite_config": "SuiteConfig",
            "knotgym.generate.images.image_recipe": "make_images",
            "knotgym.generate.images.images_config": "ImagesConfig",
            "knotgym.generate.states.generate_config": "GenerateConfig",
            "knotgym.generate.states.state_recipe": "make_states",
            "knotgym.runs.run_options": "RunOptions",
        },
    )
