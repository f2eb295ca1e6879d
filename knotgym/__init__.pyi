from .common import Failed as Failed
from .common import InvalidFile as InvalidFile
from .common import InvalidInput as InvalidInput
from .common import InvalidPolicy as InvalidPolicy
from .common import KnotgymError as KnotgymError
from .common import MissingExtra as MissingExtra
from .common import MissingFile as MissingFile
from .common import Occupied as Occupied
from .envs import KnotEnv as KnotEnv
from .envs import KnotVectorEnv as KnotVectorEnv
from .envs import TaskConfig as TaskConfig
from .envs import register_task as register_task
from .generate import verify as verify
from .rendering import PictureConfig as PictureConfig
from .rendering import draw as draw
from .rope import Rope as Rope
from .rope import RopeConfig as RopeConfig
from .states import States as States
from .states import read_states as read_states
from .states import shipped as shipped
from .topology import GaussCode as GaussCode
from .topology import label as label

__version__: str

def register_environment(task: str) -> None: ...
