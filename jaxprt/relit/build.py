"""Makes scenes ready."""

import os
import pathlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor

import filelock
import numpy as np
import tqdm

from jaxprt import require
from jaxprt.files import objects
from jaxprt.relit import lamps, reflection
from jaxprt.relit.channels import Shading, of_part
from jaxprt.relit.measuring import lights_of
from jaxprt.relit.planning import Plan, key_of, plan
from jaxprt.relit.recipes import SYSTEMS, Recipe, Target, check
from jaxprt.relit.scene import RAYS, RelitScene
from jaxprt.scene import Environment, Part, Scene
from jaxprt.systems.protocol import Joined
from jaxprt.visibility import UnfinishedError


def precompute(
    scene: Scene,
    *,
    system: str | Recipe | Mapping[str, str | Recipe] | None = None,
    error: float = 0.05,
    environments: Sequence[Environment] | None = None,
    rate: float = 30.0,
    bounces: int | str | None = None,
    rays: int = RAYS,
    roughness: tuple[float, float] | None = None,
    size: int | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> RelitScene:
    """Makes a scene ready to be relit: traces what its vertices see, and fits the BRDFs of its parts.

    All parts cast shadows on each other. Parts that emit, and point lights, light all parts; their colors and strengths
    may change afterwards.

    Args:
        scene: The scene, from `jaxprt.load_scene` or made of `jaxprt.Part`.
        system: "lobe", "harmonic" or "separable"; or sizes of one, such as `jaxprt.relit.Lobes(lobes=8)`; or one of
            these for each part, by its name.
            If None, `jaxprt.plan` chooses for each part what meets the error with the fewest bytes.
        error: Relative L2 error of the radiance of each part, for the plan.
        environments: Lights that the error must hold for, for the plan; see `jaxprt.plan`.
        rate: Frames per second with new light and new view, for the plan.
        bounces: How many times parts reflect light onto each other and themselves: a number, or "all" for as many times
            as it brings light; if None as many as the plan finds worth it, and none with `system`. Light that is
            reflected more than twice is diffuse.
        rays: With bounces, how many rays each vertex or point of a part sends for its reflections, if these are too
            sharp for the harmonics of reflected light; 0 for harmonics alone. See `RelitScene.with_rays`.
        roughness: Least and largest roughness of the materials that parts with a `TexturedMaterial` or a `BlinnPhong`
            may get later, beside those that they have. Needs `system`, "lobe" or "harmonic". Takes time to fit, and
            memory in tables.
        size: Edge of the light's cubemap faces in texels, a power of two; that of the plan's lights if None, or 64.
        path: Folder that keeps what is finished; a call that was stopped, or killed, goes on from there.
        executor: Where blocks are computed; this machine's cores if None. A `jaxprt.visibility.Part` computes its part
            of all that can be begun, for machines that share nothing but the path.
        progress: Whether to show progress bars.

    Returns:
        The scene, ready for `radiance` and `picture`.

    Raises:
        TypeError: No scene, a system of another kind, bounces that are no whole number, or a material that no system
            can have.
        ValueError: There is no such system or part, the size is no power of two, bounces are less than 0 or a word
            other than "all", roughness is not two numbers from 0 to 1, the smaller one first, or is given without a
            system, a part's material is not one that its system can have, or the store at `path` was made from
            something else.
        NotADirectoryError: There is a file at `path`.
        jaxprt.visibility.UnfinishedError: The executor's part is done, and other parts are not.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    if size is not None and (not isinstance(size, int | np.integer) or size < 1 or size & (size - 1)):
        raise ValueError(f"size must be a power of two, got {size!r}")
    reflection.check(bounces)
    if roughness is not None and not (len(roughness) == 2 and 0 <= roughness[0] <= roughness[1] <= 1):
        raise ValueError(f"roughness must be two numbers from 0 to 1, the smaller one first, got {roughness!r}")
    if roughness is not None and system is None:
        raise ValueError("roughness needs a system: the plan is for the materials that the scene has")
    folder = None if path is None else pathlib.Path(path)
    if folder is not None:
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(f"path must name a folder, got the file {folder}")
        folder.mkdir(parents=True, exist_ok=True)
    if system is None:
        wanted = _planned(scene, folder, environments=environments, error=error, rate=rate, progress=progress)
        system, size = wanted.recipes, wanted.size if size is None else size
        bounces = wanted.bounces if bounces is None else bounces
    size = 64 if size is None else size
    recipes = {part.name: _recipe(system, part.name, scene) for part in scene.parts}
    shadings = [_checked(part, recipes[part.name], roughness) for part in scene.parts]
    mesh = scene.mesh
    names = [f"{number}_{_file_name(part.name)}" for number, part in enumerate(scene.parts)]
    options = {"size": size, "executor": executor, "progress": progress}
    targets = [Target(mesh, path=folder and folder / name, **options) for name in names]
    systems, unfinished = [], []
    for part, shading, target in zip(scene.parts, shadings, targets, strict=True):
        try:
            systems.append(recipes[part.name].make(shading, target))
        except UnfinishedError as others:  # The next part of the scene does not wait for this one.
            unfinished.append(others)
    if unfinished:
        raise UnfinishedError("; ".join(map(str, unfinished)))
    lit = lamps.make(scene, shadings, systems, targets)
    reflected = None
    if bounces:
        # One store for any number of bounces: more go on from fewer.
        reflected = reflection.make(shadings, bounces, Target(mesh, path=folder and folder / "scene", **options))
    lobes = reflection.sharp(shadings, systems, folder) if bounces and rays else None
    return RelitScene(scene, Joined(tuple(systems)), shadings, reflected, lamps=lit, lobes=lobes, rays=rays)


def _checked(part: Part, recipe: Recipe, roughness: tuple[float, float] | None) -> Shading:
    """The part as systems take it, refused before any rays are traced if its system cannot have it."""
    shading = of_part(part, roughness=roughness)
    try:
        check(recipe, shading)
    except ValueError as error:
        raise ValueError(f"part {part.name!r}: {error}") from None
    return shading


def _planned(scene: Scene, folder: pathlib.Path | None, **options) -> Plan:
    """The plan, made once for a folder."""
    if folder is None:
        return _plan(scene, None, **options)
    # Where several processes share the folder, one makes the plan and the others take it.
    with filelock.FileLock(folder / ".plan.lock"):
        return _plan(scene, folder, **options)


def _plan(scene: Scene, folder: pathlib.Path | None, **options) -> Plan:
    kept = folder and folder / "plan"
    if kept is not None and kept.exists():
        found, environments = objects.load(kept), options["environments"]
        if found.key != key_of(scene, lights_of(scene) if environments is None else environments):
            raise ValueError(f"{kept} was made for another scene, other materials or other lights: name another path")
        if found.asked == options["error"] and found.rate == options["rate"]:
            return found
        raise ValueError(
            f"{kept} was made for an error of {found.asked:g} at {found.rate:g} frames per second, "
            f"got {options['error']:g} at {options['rate']:g}: name another path"
        )
    made = plan(scene, path=folder and folder / "candidates", **options)
    if options["progress"]:
        tqdm.tqdm.write(str(made))
    if kept is not None:
        objects.save(kept, made)
    return made


def _recipe(system, name: str, scene: Scene) -> Recipe:
    """The recipe of a part."""
    if isinstance(system, Mapping):
        names = [part.name for part in scene.parts]
        missing, unknown = (set(a) - set(b) for a, b in ((names, system), (system, names)))
        if missing or unknown:
            raise ValueError(f"systems must be given for each of the parts {names}, got {list(system)}")
        return _recipe(system[name], name, scene)
    if isinstance(system, str):
        if system not in SYSTEMS:
            raise ValueError(f"the system must be one of {', '.join(SYSTEMS)}, got {system!r}")
        return SYSTEMS[system]
    require.kind("the system", system, Recipe, source="jaxprt.relit.Lobes, Harmonics, Terms or Clusters")
    return system


def _file_name(name: str) -> str:
    """The name of a part in those of files: letters and digits, not too many."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)[:40]
