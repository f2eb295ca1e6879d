from .recorder import Recorder as Recorder
from .session import Session as Session
