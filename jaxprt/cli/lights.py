"""The command `jaxprt lights`: one scene in many lights, on one sheet."""

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import click
import numpy as np
import tqdm
from jaxtyping import Float

from jaxprt import files, image
from jaxprt.cli import inputs, options
from jaxprt.files import captions, outputs
from jaxprt.image.tonemap import TONES
from jaxprt.relit.build import precompute
from jaxprt.scene import Environment
from jaxprt.scene.scene import centered
from jaxprt.scene.sides import two_sided

_LINE = 28  # pixels below each picture for the name of its light


@options.command(
    "lights",
    options.FILES,
    Scene=options.SCENE,
    Light=options.LIGHT,
    Camera=options.CAMERA,
    System=[options.systems(("lobe", "harmonic", "dynamic"), "Of the scene."), options.NO_BOUNCES],
    Sizes=options.FEW_SIZES,
    Output=[
        click.Option(
            ["--output", "-o"],
            type=click.Path(path_type=Path, dir_okay=False),
            default="lights.png",
            show_default=True,
            metavar="FILE",
            help="The sheet, *.png.",
        ),
        {"columns": (options.Range(1),), "tone": (click.Choice(TONES), "srgb")},
        {"store": (click.Path(path_type=Path, file_okay=False),)},
        options.JSON,
    ],
)
def command(chosen: SimpleNamespace) -> options.Result:
    """Draw a scene in each of many lights, one beside the other on one sheet.

    FILEs are meshes, scenes and environments in any order. Each picture has the exposure that suits it, and the name of
    its light below. Environments are read one after the other, so that there may be any number.

    \b
    Examples:
      jaxprt lights scene.glb maps/*.hdr
      jaxprt lights scene.glb maps/*.exr --turn 0,90,180,270 --columns 4 --output sheet.png --store kept

    Options:
        columns: Pictures in a row.  [default: as many as rows]
        tone: Tone curve of the pictures.
        store: Folder that keeps precomputed data for later runs.
    """  # noqa: D301
    path = outputs.target(chosen.output, ".png")
    if len(chosen.system) > 1 or len(chosen.lobes or ()) > 1:
        raise click.UsageError("a sheet is of one system and one number of lobes, got several")
    options.make_folder(chosen.store)
    (system,), scene = chosen.system, two_sided(centered(options.call(inputs.scene, chosen)))
    camera = options.call(inputs.camera, chosen, parts=inputs.objects(scene, chosen))
    for _ in _lights(chosen):  # a broken file is told before anything is traced
        pass
    (recipe,) = options.recipes(system, chosen).values()
    progress, store = sys.stderr.isatty(), chosen.store and chosen.store / system
    wanted = {"size": chosen.light_size or inputs.LIGHT_SIZE, "bounces": chosen.bounces, "path": store}
    relit = precompute(scene, system=recipe, refine=False, progress=progress, **wanted)
    view, shown = relit.picture_view(camera), {}
    for name, light in tqdm.tqdm(_lights(chosen), desc="lights", unit="light", disable=not progress):
        picture = view.picture(light)
        shown[name] = np.asarray(image.display(picture, tone=chosen.tone, stops=relit.exposure(picture, camera)))
    columns = min(chosen.columns or math.ceil(math.sqrt(len(shown))), len(shown))
    files.write_png(path, sheet(shown, columns=columns))
    return options.Result(
        {"lights": list(shown), "sheet": path}, f"{path} shows {len(shown)} light{'s' * (len(shown) > 1)}"
    )


def _lights(chosen: SimpleNamespace) -> Iterator[tuple[str, Environment]]:
    """The lights by their names, read one after the other."""
    _, paths = inputs.split_files(chosen.files)
    names = inputs.unique([path.stem for path in paths])
    for name, path in zip(names, paths, strict=True):
        for told, light in options.call(inputs.lights, chosen, files=[path]).items():
            yield name + told.removeprefix(path.stem), light
    if not paths:
        yield from options.call(inputs.lights, chosen, files=()).items()


def sheet(pictures: dict[str, Float[np.ndarray, "h w 3"]], *, columns: int) -> Float[np.ndarray, "_ _ 3"]:
    """Pictures of one size in rows, with their names below."""
    height, width, _ = next(iter(pictures.values())).shape
    result = np.ones((-(-len(pictures) // columns) * (height + _LINE), columns * width, 3), np.float32)
    for number, (name, picture) in enumerate(pictures.items()):
        row, column = divmod(number, columns)
        place = result[row * (height + _LINE) :, column * width : (column + 1) * width]
        place[:height] = picture
        place[height : height + _LINE] = captions.line(name, width=width, height=_LINE)
    return result
