"""Environments in the forms that trainers expect: Stable-Baselines3, goal-conditioned, OGBench. The
rules of the game stay in `knotgym.envs`. Read `goal_environment.py` first.

`sb3_vec_env` makes a Stable-Baselines3 `VecEnv` over one batched simulation, `goal_env` an
environment for hindsight experience replay. `OGBenchEnv` is the environment behind the ids
`knotgym/tie-nx2-v0` and the like, for OGBench's agents. All names are imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
