"""Blocks of episodes: the calls of recipes that play.

Episode i of a run has a seed of its own, so a block may have any size and be played anywhere.
"""

from knotgym.envs import TaskConfig
from knotgym.rope import MUJOCO

# pieces of a run, so that workers have equal shares; episodes of a block, at least and at most. The
# chain engine steps many ropes in little more time than one, MuJoCo doesn't.
_CHAIN, _MUJOCO = (4, 64, 1024), (32, 8, 64)
_MOST_STEPS = 2**17  # of a block, which bounds its memory


def blocks(episodes: int, task: TaskConfig, first: int = 0) -> list[range]:
    """Divide the numbers of a run's episodes, from a first one on, into blocks of about equal size.

    >>> blocks(200, TaskConfig(task="tie", engine="chain"))
    [range(0, 50), range(50, 100), range(100, 150), range(150, 200)]
    """
    pieces, least, most = _MUJOCO if task.engine == MUJOCO else _CHAIN
    most = min(most, max(1, _MOST_STEPS // (task.horizon + 1)))
    size = min(max(-(-episodes // pieces), least), most)
    count = -(-episodes // size)
    ends = [first + number * episodes // count for number in range(count + 1)]
    return [range(begin, end) for begin, end in zip(ends[:-1], ends[1:], strict=True)]
