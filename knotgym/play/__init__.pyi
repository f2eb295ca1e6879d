from .hand import HandTab as HandTab
from .page import Page as Page
from .page_config import PageConfig as PageConfig
from .recorder import Recorder as Recorder
from .session import Session as Session
