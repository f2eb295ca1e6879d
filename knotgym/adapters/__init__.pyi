from .goal_environment import OGBenchEnv as OGBenchEnv
from .goal_environment import goal_env as goal_env
from .sb3 import sb3_vec_env as sb3_vec_env
