"""Precomputes scenes for relighting."""

import dataclasses
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any

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
from jaxprt.systems.bounces import GroupBounces
from jaxprt.systems.protocol import System
from jaxprt.visibility import Run, UnfinishedError
from jaxprt.visibility.blocks import Progress, fingerprint

_MOST = 1 << 13  # texels along the edge of a face
_SIZE = 64  # texels along the edge of a face of the light, without a plan
_COARSE = 16  # rays along the edge of a face in a preview: 768 above the horizon of a vertex


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
    progress: Progress = True,
    preview: Callable[[RelitScene], None] | None = None,
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
            alone. What rays hit is seen with the light that it reflects, one bounce more than `bounces`. Without
            bounces, pictures trace rays of very smooth parts for what hides the light; see `RelitScene.with_rays`.
        refine: Largest relative L2 error that interpolation between vertices may cause in pictures, as `jaxprt.refine`
            defines it; True for 0.008, False to keep the mesh. `RelitScene.mesh` is the divided mesh, and
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
        progress: Whether to show progress bars. A function is called in place of them, with the name of the work, such
            as "refine" or "visibility", and the share that is done, from 0 to 1. An error that it raises ends the call.
        preview: Function that is called with scenes of less quality, in this thread, as soon as they exist. The first
            has coarse visibility, from 768 rays, at the vertices before division. The next has coarse
            visibility at all vertices. With bounces, the last has everything except bounces. They take the same lights,
            eyes and materials as the result, which does not depend on `preview`. Coarse previews are left out where
            they would take long, because a BRDF has to be fitted or a system factored, and where `path` holds finished
            work.

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
    coarse = None
    if preview is not None and recipes is not None:
        coarse = _coarse(scene, recipes, size or _SIZE, folder, _of_preview(progress), rays=rays, copied=copied)
        if coarse is not None:
            preview(coarse)
    before = scene
    scene, divided = refinement.divided(
        scene, refine, vertices=vertices, environments=environments, folder=folder, progress=progress
    )
    if recipes is None:
        wanted = _planned(scene, folder, environments=environments, error=error, rate=rate, progress=progress)
        recipes, size = _recipes(wanted.recipes, scene), wanted.size if size is None else size
        bounces = wanted.bounces if bounces is None else bounces
    size = _SIZE if size is None else size
    fields = {"rays": rays, "division": divided, "copied": copied}
    if preview is not None and scene is not before and coarse is not None:
        coarse = _coarse(scene, recipes, size, folder, _of_preview(progress), **fields)
        if coarse is not None:
            preview(coarse)
    near = centered(scene)
    shadings = shaded(near.parts, recipes)
    _warn(scene, near, shadings, recipes)
    traced = _Traced.of(scene, near, shadings, recipes, size, run)
    direct = traced.relit(**fields)
    if not bounces:
        return direct
    if preview is not None:
        preview(direct)
    # One store serves any number of bounces: a larger number resumes from a smaller one.
    target = Target(traced.near.mesh, size=size, run=run.within("scene"))
    return traced.relit(traced.reflected(bounces, target, rays=rays), **fields)


def _of_preview(progress: Progress) -> Progress:
    """Progress whose labels start with "preview", if it is a function."""
    return (lambda label, share: progress(f"preview {label}", share)) if callable(progress) else progress


def _as_shaded(scene: Scene, shadings: Sequence[Shading]) -> Scene:
    """The scene with the materials that its systems show."""
    return dataclasses.replace(scene, parts=list(map(channels.as_shaded, scene.parts, shadings)))


def _warn(scene: Scene, near: Scene, shadings: Sequence[Shading], recipes: Sequence[Recipe]) -> None:
    """Warns of scenes that look wrong although they are drawn as asked, before rays are traced."""
    warn.of_gain(near, shadings)
    warn.of_omissions(near.parts, shadings, recipes)
    warn.of_shells(near)
    scene = _as_shaded(scene, shadings)
    warn.of_backs(scene, scene.mesh, default_camera(scene, scene.mesh))


@dataclasses.dataclass(frozen=True)
class _Traced:
    """Direct light of a scene: the system of each group, and the emitting parts and point lights, if there are any."""

    scene: Scene  # with the materials that its systems show
    near: Scene  # the scene with its origin at zero
    shadings: list[Shading]
    layout: groups.Layout  # where the vertices of the parts stand in the groups
    systems: list[System]
    lamps: lamps.SceneLamps | None

    @classmethod
    def of(
        cls, scene: Scene, near: Scene, shadings: list[Shading], recipes: Sequence[Recipe], size: int, run: Run
    ) -> "_Traced":
        """Traces the rays of a scene."""
        scene = _as_shaded(scene, shadings)
        parts = groups.kinds(shadings, recipes)
        layout = groups.Layout.of(scene.counts, parts, [recipes[members[0]].joins for members in parts])
        names = [_file_name(members, scene) for members in layout.parts]
        targets = [Target(near.mesh, size=size, run=run.within(name)) for name in names]
        systems = _systems(recipes, shadings, targets, layout)
        lit = lamps.make(near, shadings, layout, systems, targets, scene.point_lights)
        return cls(scene, near, shadings, layout, systems, lit)

    def reflected(self, bounces: int | str, target: Target, *, rays: int) -> GroupBounces:
        """Light that the parts reflect onto each other."""
        lamp, systems = self.lamps and self.lamps.transport(self.layout), self.systems if rays else None
        return reflection.make(self.shadings, self.layout, bounces, target, lamp=lamp, systems=systems)

    def relit(self, reflected: GroupBounces | None = None, **fields: Any) -> RelitScene:
        """The relit scene."""
        return RelitScene(self.scene, self.shadings, self.layout, self.systems, reflected, lamps=self.lamps, **fields)


def _coarse(
    scene: Scene,
    recipes: Sequence[Recipe],
    size: int,
    folder: pathlib.Path | None,
    progress: Progress,
    **fields: Any,
) -> RelitScene | None:
    """The scene by few rays. None if it would take long, or if the folder has results of rays."""
    simple = [coarse for recipe in recipes if (coarse := recipe.coarse()) is not None]
    if len(simple) < len(recipes) or (folder is not None and any(folder.glob("*/*.prt"))):
        return None
    near = centered(scene)
    shadings = shaded(near.parts, simple)
    if any(shading.table is None and not shading.matte for shading in shadings):
        return None
    run = Run(progress=callable(progress) and progress, texels=_COARSE)
    return _Traced.of(scene, near, shadings, simple, size, run).relit(**fields)


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
    recipes: Sequence[Recipe], shadings: Sequence[Shading], targets: Sequence[Target], layout: groups.Layout
) -> list[System]:
    """The system of each group."""
    systems, unfinished = [], []
    for members, size, target in zip(layout.parts, layout.size, targets, strict=True):
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
    """A name for a group's files: up to 40 letters and digits of its first part's name, and a key of several parts."""
    name = "".join(letter if letter.isalnum() else "_" for letter in scene.parts[parts[0]].name)[:40]
    return f"{parts[0]}_{name}" + (f"_{fingerprint(np.asarray(parts))[:8]}" if len(parts) > 1 else "")
