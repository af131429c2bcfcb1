"""Precomputes scenes for relighting."""

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor

import filelock
import numpy as np
import tqdm

from jaxprt import require
from jaxprt.compile import promoted
from jaxprt.files import objects
from jaxprt.relit import channels, groups, lamps, refinement, reflection, registry, tracing, warn
from jaxprt.relit.channels import Shading
from jaxprt.relit.measuring import check_lights, lights_of
from jaxprt.relit.planning import ERROR, MARGIN, Plan, key_of, plan
from jaxprt.relit.recipes import Recipe, Target, check
from jaxprt.relit.scene import RAYS, RelitScene
from jaxprt.scene import Environment, Part, Scene, sides
from jaxprt.scene.scene import centered, default_camera
from jaxprt.systems.protocol import System
from jaxprt.visibility import Run, UnfinishedError
from jaxprt.visibility.blocks import fingerprint

_MOST = 1 << 13  # texels along the edge of a face


@promoted
def precompute(
    scene: Scene,
    *,
    system: str | Recipe | Mapping[str, str | Recipe] | None = None,
    error: float | None = None,
    environments: Sequence[Environment] | None = None,
    rate: float = 30.0,
    bounces: int | str | None = None,
    rays: int = RAYS,
    refine: bool | float = True,
    vertices: int | None = None,
    size: int | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> RelitScene:
    """Precomputes a scene for relighting: traces visibility at its vertices and fits the BRDFs of its parts.

    Meshes are divided first where visibility needs it, as `jaxprt.refine` does, because visibility is interpolated
    between vertices. All parts cast shadows on each other. Parts that emit light, and point lights, illuminate all
    parts. Their colors and strengths may change after precomputation. Holes, opacity and backs are those of the scene's
    materials.

    Before that, parts with `back="lit"` get reversed copies of the faces whose backs can be seen
    (`jaxprt.scene.sides.two_sided`). In `RelitScene.mesh` the copies of a part follow its vertices and faces.

    Args:
        scene: Scene from `jaxprt.load_scene`, or built from `jaxprt.Part`.
        system: Name of a system ("lobe", "dynamic", "harmonic" or "separable", or one that `jaxprt.register` was
            given), or a recipe with its own parameters, such as `jaxprt.relit.Lobes(lobes=8)`, or a dictionary from the
            name of each part to one of these. If None, `jaxprt.plan` chooses the system with the fewest bytes that
            meets `error`, for each kind of material.
        error: Largest relative L2 error of the radiance of each part. Only used by the plan. If None, 0.05, or the
            smallest error that can be reached, with a warning.
        environments: Environments under which the error must hold; see `jaxprt.plan`. Only used by the plan.
        rate: Frames per second, each with a new light and a new view. Only used by the plan.
        bounces: Number of times that light is reflected between surfaces, or "all" for as many as contribute. If None,
            the plan decides; with a given `system` there are no bounces. Bounces after the second are treated as
            diffuse.
        rays: Number of reflection rays that each vertex or point of a sharp part sends. A part is sharp if its
            reflections are too sharp for the low-order harmonics that represent reflected light. 0 uses harmonics
            alone. What rays hit is seen with the light that it reflects, one bounce more than `bounces`. Only used with
            bounces; see `RelitScene.with_rays`.
        refine: Largest relative L2 error that interpolation between vertices may cause in pictures, as `jaxprt.refine`
            defines it; True for 0.015, False to keep the mesh. `RelitScene.mesh` is the divided mesh, and
            `RelitScene.file_vertex` says which of its vertices are those of the scene. What is known of the lights,
            `environments`, makes it sharper.
        vertices: Largest number of vertices after division, with a warning where it is met. If None, twice as many as
            the scene has, plus 5,000.
        size: Edge of the light's cubemap faces in texels, a power of two. If None, that of the plan's lights, or 64
            without a plan.
        path: Folder in which finished work is stored. A call that was interrupted resumes from there.
        executor: Executor that computes the blocks of work. If None, all cores of this machine. A
            `jaxprt.visibility.Shard` computes only its share of the blocks, for machines that have nothing in common
            but `path`. A `ProcessPoolExecutor` must have the context "spawn", since forked processes hang where JAX
            runs.
        progress: Whether to show progress bars.

    Returns:
        The precomputed scene, with the methods `radiance` and `picture`. A warning names parts that the scene's camera
        sees mostly from behind, where they are black, and BRDFs that reflect more light than they get.

    Raises:
        TypeError: `scene` is not a `Scene`; `system` is not a name, a recipe or a dictionary; `bounces` is not a whole
            number; or a part has a material that no system supports.
        ValueError: There is no system or part of the given name; `size` is not a power of two; `bounces` is negative or
            a word other than "all"; the system of a part does not support its material; or the store at `path` was
            made from other inputs.
        NotADirectoryError: `path` is a file.
        jaxprt.visibility.UnfinishedError: The share of this executor is done, but other shares are not.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    scene, copied = sides.with_copies(scene)
    run = Run(path, executor, progress)
    _check_options(size, error, rate, environments, rays)
    reflection.check(bounces)
    recipes = None if system is None else _recipes(system, scene)
    folder = None if path is None else pathlib.Path(path)
    if folder is not None:
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(f"path must name a folder, got the file {folder}")
        folder.mkdir(parents=True, exist_ok=True)
    scene, divided = refinement.divided(
        scene, refine, vertices=vertices, environments=environments, folder=folder, progress=progress
    )
    if recipes is None:
        wanted = _planned(scene, folder, environments=environments, error=error, rate=rate, progress=progress)
        recipes, size = _recipes(wanted.recipes, scene), wanted.size if size is None else size
        bounces = wanted.bounces if bounces is None else bounces
    size = 64 if size is None else size
    near = centered(scene)
    shadings = shaded(near.parts, recipes)
    scene = dataclasses.replace(scene, parts=list(map(channels.as_shaded, scene.parts, shadings)))
    mesh, whole = near.mesh, scene.mesh
    warn.of_gain(near, shadings)
    warn.of_shells(near)
    warn.of_backs(scene, whole, default_camera(scene, whole))
    parts = groups.kinds(shadings, recipes)
    place = groups.Place.of(scene.counts, parts, [recipes[members[0]].joins for members in parts])
    names = [_file_name(members, scene) for members in place.parts]
    targets = [Target(mesh, size=size, run=run.within(name)) for name in names]
    systems = _systems(recipes, shadings, targets, place)
    lit = lamps.make(near, shadings, place, systems, targets, scene.point_lights)
    reflected = None
    if bounces:
        # One store serves any number of bounces: a larger number resumes from a smaller one.
        target = Target(mesh, size=size, run=run.within("scene"))
        lamp = lit and lit.transport(place)
        reflected = reflection.make(shadings, place, bounces, target, lamp=lamp, systems=systems if rays else None)
    fields = {"lamps": lit, "rays": rays, "division": divided, "copied": copied}
    return RelitScene(scene, shadings, place, systems, reflected, **fields)


def shaded(parts: Sequence[Part], recipes: Sequence[Recipe]) -> list[Shading]:
    """The `Shading` of each part. Refuses parts that their systems do not support, before tracing rays."""
    looks = channels.looks(parts)
    result = []
    for part, look, recipe in zip(parts, looks, recipes, strict=True):
        shading = channels.of_part(part, look=look, takes=recipe.takes)
        try:
            check(recipe, shading)
        except ValueError as error:
            raise ValueError(f"part {part.name!r}: {error}") from None
        result.append(shading)
    return result


def _systems(
    recipes: Sequence[Recipe], shadings: Sequence[Shading], targets: Sequence[Target], place: groups.Place
) -> list[System]:
    """The system of each group."""
    systems, unfinished = [], []
    for members, size, target in zip(place.parts, place.size, targets, strict=True):
        recipe, shading = recipes[members[0]], groups.joined([shadings[part] for part in members])
        try:
            systems.append(recipe.make(shading, target, vertices=size if recipe.joins else None))
        except UnfinishedError as others:  # Go on with the next group of the scene.
            unfinished.append(others)
    if unfinished:
        raise UnfinishedError("; ".join(map(str, unfinished)))
    return systems


def _check_options(size, error, rate, environments, rays) -> None:
    """Refuses options of wrong kinds, and numbers that no system takes."""
    whole = isinstance(size, int | np.integer) and not isinstance(size, bool)
    if size is not None and not (whole and 1 <= size <= _MOST and size & (size - 1) == 0):
        raise ValueError(f"size must be a power of two, got {require.shown(size)}; the largest is {_MOST}")
    for name, value in (("error", error), ("rate", rate)):
        if value is not None:
            require.number(name, value, 0.0, above=True)
    if environments is not None:
        check_lights(environments, 1.0, 1.0)
    tracing.check_rays(rays)


def _planned(scene: Scene, folder: pathlib.Path | None, **options) -> Plan:
    """The plan of a scene, made once for a folder."""
    if folder is None:
        return _plan(scene, None, **options)
    # If several processes share the folder, one of them makes the plan and the others load it.
    with filelock.FileLock(folder / ".plan.lock"):
        return _plan(scene, folder, **options)


def _plan(scene: Scene, folder: pathlib.Path | None, **options) -> Plan:
    store = folder and folder / "plan"
    if store is not None and store.exists():
        stored, environments = objects.load(store), options["environments"]
        if not isinstance(stored, Plan):
            raise ValueError(f"{store} is damaged: it must hold a plan, got a {type(stored).__name__}")
        if stored.key != key_of(centered(scene), lights_of(scene) if environments is None else environments):
            raise ValueError(f"{store} was made for another scene, other materials or other lights: name another path")
        asked = ERROR if options["error"] is None else options["error"]
        if (stored.asked, stored.rate) != (asked, options["rate"]):
            raise ValueError(
                f"{store} was made for an error of {stored.asked:g} at {stored.rate:g} frames per second, "
                f"got {asked:g} at {options['rate']:g}: name another path"
            )
        if options["error"] is None or stored.error * MARGIN <= asked:
            return stored
    planned = plan(scene, refine=False, path=folder and folder / "candidates", **options)
    if options["progress"]:
        tqdm.tqdm.write(str(planned))
    if store is not None:
        objects.save(store, planned)
    return planned


def _recipes(system: str | Recipe | Mapping[str, str | Recipe], scene: Scene) -> list[Recipe]:
    """The recipe of each part."""
    return [_recipe(system, part.name, scene) for part in scene.parts]


def _recipe(system, name: str, scene: Scene) -> Recipe:
    """The recipe of the part of a name."""
    if isinstance(system, Mapping):
        names = scene.names
        missing, unknown = (set(a) - set(b) for a, b in ((names, system), (system, names)))
        if missing or unknown:
            raise ValueError(f"systems must be given for each of the parts {names}, got {list(system)}")
        return _recipe(system[name], name, scene)
    if isinstance(system, str):
        recipes = registry.systems()
        if system not in recipes:
            raise ValueError(f"the system must be one of {', '.join(recipes)}, got {system!r}")
        return recipes[system]
    require.kind("the system", system, Recipe, source="jaxprt.relit.Lobes, Harmonics, Dynamic, Terms or Clusters")
    return system


def _file_name(parts: Sequence[int], scene: Scene) -> str:
    """A name for the files of a group: at most 40 letters and digits of its first part's name.

    A key of the indices of the parts follows where there are several.
    """
    name = "".join(letter if letter.isalnum() else "_" for letter in scene.parts[parts[0]].name)[:40]
    return f"{parts[0]}_{name}" + (f"_{fingerprint(np.asarray(parts))[:8]}" if len(parts) > 1 else "")
