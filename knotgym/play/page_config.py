"""The configuration of `knotgym play`; nothing here computes: the command line reads it."""

from typing import Annotated

from pydantic import Field

from knotgym.common import Seed, configuration
from knotgym.control import PolicyConfig
from knotgym.envs import TaskConfig
from knotgym.rope import CHAIN


@configuration
class PageConfig:
    """What is played, and where the page is served.

    Attributes:
        task: the environment.
        seed: random seed; episode i is the one that `knotgym evaluate` plays with the same seed.
        policy: which policy can take over, as in evaluate.
        player: who plays, in a few words; stored with what is recorded.
        port: port of the page, on the loopback.
    """

    task: TaskConfig = TaskConfig(task="tie", observation="state", engine=CHAIN)
    seed: Seed = 0
    policy: PolicyConfig = PolicyConfig(policy="expert")
    player: str = ""
    port: Annotated[int, Field(ge=0, le=65535)] = 8080
