"""Frames per second that `knotgym play` sends to one client while a policy pulls, by engine.

    python benchmarks/play.py --seconds 10

The client counts the messages that move the rope. Needs the extra `play`.
"""

from __future__ import annotations

import argparse
import socket
import time

from knotgym.envs.tasks import TaskConfig
from knotgym.play.page import Page, PlayConfig
from knotgym.rope.engines import ENGINES

_LONG = 1000  # bytes


def frames(engine: str, seconds: float) -> float:
    """Frames per second of rope under uninterrupted pulls."""
    import msgspec
    import viser
    from websockets.sync.client import connect

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    task = TaskConfig(task="tie", nx=2, observation="state", engine=engine, horizon=10_000)
    with Page(PlayConfig(task=task, policy="scripted", compared="", port=port)) as page:
        protocols = [f"viser-v{viser.__version__}"]
        with connect(page.address.replace("http", "ws"), subprotocols=protocols) as client:
            camera = {
                "type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "position": (0, 0, 4),
                "fov": 1.0, "near": 0.01, "far": 9.0, "image_height": 90, "image_width": 90,
                "look_at": (0, 0, 0), "up_direction": (0, 1, 0),
            }  # fmt: skip
            client.send(msgspec.msgpack.encode(camera))
            while not page.players:
                time.sleep(0.1)
            player = page.players[0]
            player._auto.value = True
            end_of_warmup, seen = time.monotonic() + 3, 0
            while (now := time.monotonic()) < end_of_warmup + seconds:
                if player.session.ended:
                    player._wants(player._next)
                # messages are compressed; only those that move the rope are this long
                moved = len(client.recv(timeout=60)) > _LONG
                seen += moved and now > end_of_warmup
    return seen / seconds


def main() -> None:
    """Print a line per engine."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    seconds = parser.parse_args().seconds
    for engine in ENGINES:
        print(f"{engine}: {frames(engine, seconds):.1f} frames a second")


if __name__ == "__main__":
    main()
