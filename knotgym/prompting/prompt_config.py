"""The configuration of `knotgym prompt`; nothing here computes: the command line reads it."""

from typing import Literal

from pydantic import PositiveInt

from knotgym.common import InvalidInput, Seed, configuration
from knotgym.envs import TaskConfig
from knotgym.prompting.chat import ChatConfig


@configuration
class PromptConfig:
    """Settings of a run.

    Attributes:
        mode: what is asked; open: one answer with all actions; stateless: one action per request;
            stateful: the same, with past pictures and answers; read: the Gauss code of a picture.
        chat: settings of the client.
        task: the environment; its horizon limits the actions, and its image_size is that of each
            picture. Unused in mode read.
        episodes: number of episodes, or of pictures from the start of the split.
        seed: random seed of the episodes. Episode i is the same in every mode and in `evaluate`.
        window: past turns included in mode stateful.
        tell_centre: tell the model the world coordinates of the picture's centre.
        pictures: in mode read, the split of the pictures, then the SHA-256 of them all.
        side_by_side: concurrent requests to the server; makes no difference to them.
    """

    mode: Literal["open", "stateless", "stateful", "read"] = "stateless"
    chat: ChatConfig
    task: TaskConfig = TaskConfig(task="tie", image_size=256)
    episodes: PositiveInt = 100
    seed: Seed = 0
    window: PositiveInt = 4
    tell_centre: bool = False
    pictures: tuple[str, ...] = ()
    side_by_side: PositiveInt = 4

    def __post_init__(self) -> None:
        if self.task.views != ("top",) or self.task.depth:
            raise InvalidInput("prompts support only the view from the top, without depth")
