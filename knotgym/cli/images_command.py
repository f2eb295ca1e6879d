"""The command `knotgym images`."""

from pathlib import Path

from knotgym import generate
from knotgym.cli.options import RUN, Given, as_typed, command
from knotgym.generate import ImagesConfig
from knotgym.states import is_bundled


@command(
    {"": ImagesConfig},
    "nx count appearance.name=--appearance appearance.vary=--vary appearance.sizes=--size"
    f" engine {RUN}",
)
def images(given: Given, *, out: Path | None = None, states: str | None = None) -> None:
    """Generate labelled pictures for perception.

    Each comes with its Gauss code, crossings, rope coordinates and a grade of difficulty. Needs the
    extra huggingface: pip install '.[huggingface]'.

    Examples:

        knotgym images --nx 0-4 --count 20000

        knotgym images --nx 2,3 --count 500 --vary all --size 64,128

        knotgym images --nx 3,4 --count 100 --appearance line

        knotgym images --nx 1-4 --count 1000 --appearance photo --size 256

    Args:
        out: Folder to write; by default knotgym-data/images-nx0-4 for --nx 0-4.
        states: Start from a set of states: readable (default), bench, random-walk or hard-unknots,
            which are included; or a states.h5.
    """

    config, usual = given.config(ImagesConfig), ImagesConfig().appearance.name
    marks = [f"images-nx{as_typed(config.nx)}"]
    if states:
        whence = states if is_bundled(states) else Path(states).absolute().parent.name
        marks.append(f"from-{whence}")
    marks += [name for name in (config.appearance.name,) if name != usual]
    marks += ["varied"] * bool(config.appearance.vary)
    folder = given.folder(out, "-".join(marks))
    generate.make_images(config, folder, given.run, states=states, progress=given.progress)
