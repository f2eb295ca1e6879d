"""Adapters of the environments to other libraries.

`sb3_vec_env` makes a Stable-Baselines3 `VecEnv` over one batched simulation, `goal_env` an
environment for hindsight experience replay. `OGBenchEnv` is the environment behind the ids
`knotgym/tie-nx2-v0` and the like, for OGBench's agents. All names are imported on first use.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from knotgym.adapters.goal_environment import GoalEnv as GoalEnv
    from knotgym.adapters.goal_environment import goal_env as goal_env
    from knotgym.adapters.ogbench_environment import OGBenchEnv as OGBenchEnv
    from knotgym.adapters.sb3 import sb3_vec_env as sb3_vec_env
else:
    from knotgym.common.lazy_exports import lazy_exports

    __getattr__, __dir__, __all__ = lazy_exports(
        __name__,
        {
            "knotgym.adapters.goal_environment": "GoalEnv goal_env",
            "knotgym.adapters.ogbench_environment": "OGBenchEnv",
            "knotgym.adapters.sb3": "sb3_vec_env",
        },
    )
