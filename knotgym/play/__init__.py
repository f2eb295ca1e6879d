"""The rope in a browser: pull it by hand, watch episodes, record them."""

from knotgym.common.lazy_exports import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "Page": "knotgym.play.page",
        "PlayConfig": "knotgym.play.page",
        "Recorder": "knotgym.play.recorder",
        "Session": "knotgym.play.session",
        "WatchPage": "knotgym.play.watch",
    },
)
