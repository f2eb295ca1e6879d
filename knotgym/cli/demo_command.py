"""The command `knotgym demo`."""

import importlib.util
from pathlib import Path

from knotgym import common, control, datasets, envs, loaders, rendering, runs
from knotgym.cli.options import Given, command


@command({}, "run.overwrite")
def demo(given: Given, *, out: Path = Path("knotgym-data/demo")) -> None:
    """Film the expert tying a knot diagram; takes seconds, a minute on the first run.

    Writes an observation, a film and an HTML page.

    Args:
        out: Folder to make.
    """
    progress, overwrite = given.progress, given.run.overwrite
    progress.stage("loading the simulator")
    from PIL import Image

    from knotgym.control import PolicyConfig, compile_planning
    from knotgym.generate import CollectConfig, collect, film

    common.require_output(out, folder=True, overwrite=overwrite, reads=[])
    runs.compile_first(progress, plan=compile_planning)
    task = envs.TaskConfig(task="tie", nx=3, split="test", observation="both")
    config = CollectConfig(task=task, policy=PolicyConfig(policy="expert"), episodes=2)
    film_name = "expert.mp4" if importlib.util.find_spec("av") else "expert.gif"
    with common.atomic_write(out, overwrite=overwrite) as folder:
        folder.mkdir()
        progress.stage("the expert plays two episodes of tie with 3 crossings")
        options, silent = runs.RunOptions(workers=1, quiet=True), runs.Progress(quiet=True)
        dataset = collect(config, folder / "minari", options, progress=silent)
        played = datasets.open_episodes(dataset)
        shown = loaders.Transitions(dataset, observation="pixels").observations(0, 0, 1)
        first = Image.fromarray(shown[0])
        size = (4 * first.width, 4 * first.height)
        first.resize(size, Image.Resampling.NEAREST).save(folder / "reset.png")
        progress.stage("drawing the film and the page")
        rendering.Film(folder / film_name).write(film(played.episodes, config.task))
        datasets.write_page(folder / "page.html", datasets.locate(str(dataset)), control.replay)
    reached = int(played.episodes.episodes["success"].sum())
    progress.say(f"{out / 'reset.png'}: the first observation, with the rope beside its goal")
    progress.say(f"{out / film_name}: the expert reaches the goal in {reached} of 2 episodes")
    progress.say(f"{out / 'page.html'}: the same episodes, to play and rotate in a browser")
    progress.say("next: knotgym-generate --nx 3 --count 40, or the example in the README")
