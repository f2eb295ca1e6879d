from .page import serve as serve
from .page_config import PageConfig as PageConfig
from .recorder import Recorder as Recorder
from .session import Session as Session
