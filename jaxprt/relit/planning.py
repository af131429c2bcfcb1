"""Chooses the system of each group of parts, and its parameters: the one with the fewest bytes that meets an error.

Candidate recipes are run on a sample of each part's vertices. Their error is measured against the exact sum over all
texels, from eight views, under every light. Bytes and times of the sample are scaled to the whole part.
"""

import math
import operator
import os
import pathlib
import re
import warnings
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxprt import require
from jaxprt.compile import promoted
from jaxprt.files import objects
from jaxprt.relit import channels, groups, refinement, reflection, registry
from jaxprt.relit.measuring import check_lights, lights_of, views_around
from jaxprt.relit.recipes import Lobes, Recipe, Terms
from jaxprt.relit.sampling import Candidate, Sample
from jaxprt.scene import Environment, Scene, sides
from jaxprt.scene.scene import centered
from jaxprt.visibility import Run, blocks

ERROR = 0.05  # that is asked for where none is given
MARGIN = 1.25  # safety factor on the error, for lights and views that were not measured
_SAVING = 0.1  # smallest saving, as a fraction of the bytes, for which another system is measured
_SLOW = 2.0  # a faster candidate may have this many times the bytes of one that is too slow


class GroupPlan(eqx.Module):
    """The plan of one group: all parts with materials of one kind.

    Attributes:
        names: Names of the parts.
        vertices: Number of vertices of all of them.
        mesh_error: Relative L2 error that the mesh adds in any system, under the worst of the lights. It comes from
            shadows that are finer than the triangles.
        chosen: The chosen candidate.
        considered: All candidates, in the order in which they were measured.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    vertices: int
    mesh_error: float
    chosen: Candidate
    considered: tuple[Candidate, ...]


class Plan(eqx.Module):
    """The plan of a scene; `print` shows it as a table.

    Attributes:
        names: Names of the parts.
        group: One plan for each group of parts.
        reflected: Fraction of each part's radiance (column) that was reflected by other surfaces at least once (row 0),
            twice (row 1) and three times (row 2). Relative L2, estimated for diffuse surfaces.
        bounces: Smallest number of bounces that omits at most `asked` of the radiance of every part: 0, 1, 2 or "all".
        asked: The requested error.
        rate: The requested number of frames per second.
        size: Edge of the lights' cubemap faces in texels.
        key: Fingerprint of the scene and the lights. A stored plan with another fingerprint is refused.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    group: tuple[GroupPlan, ...]
    reflected: Float[np.ndarray, "b p"]
    bounces: int | str
    asked: float
    rate: float
    size: int
    key: str

    @property
    def error(self) -> float:
        """Predicted relative L2 error of the group with the largest error."""
        return max(group.chosen.error for group in self.group)

    @property
    def seconds(self) -> float:
        """Time of a frame with a new light and a new view on this machine, without rasterization."""
        return sum(group.chosen.seconds for group in self.group)

    @property
    def nbytes(self) -> int:
        """Size of transport and BRDFs in bytes, without the data of bounces."""
        return sum(group.chosen.nbytes for group in self.group)

    @property
    def recipes(self) -> dict[str, Recipe]:
        """The recipe of each part, for `jaxprt.precompute`."""
        return {name: group.chosen.recipe for group in self.group for name in group.names}

    def __str__(self) -> str:
        """The table of all candidates; a star marks the chosen one."""
        rows = [f"error asked {100 * self.asked:g} %, {self.rate:g} frames per second"]
        for group in self.group:
            rows.append(f"{', '.join(group.names)}: {group.vertices} vertices")
            chosen = repr(group.chosen.recipe)  # In a plan loaded from a file, `chosen` is a copy: compare by value.
            rows += [f"  {'*' if repr(row.recipe) == chosen else ' '} {row}" for row in group.considered]
            advice = "; `jaxprt.refine` divides its triangles" if group.mesh_error > self.asked else ""
            rows.append(f"    {100 * group.mesh_error:.1f} % of shadows between its vertices{advice}")
        for name, (once, twice, often) in zip(self.names, 100 * self.reflected.T, strict=True):
            rows.append(
                f"{name}: {once:.1f} % of its light is reflected, {twice:.1f} % twice or more, "
                f"{often:.1f} % three times or more"
            )
        rows.append(f"bounces: {self.bounces}")
        total = f"{100 * self.error:.1f} %, {1e3 * self.seconds:.1f} ms a frame, {self.nbytes / 1e6:.2f} MB"
        slow = "" if self.seconds * self.rate <= 1 else f"; slower than the {self.rate:g} frames per second asked for"
        return "\n".join([*rows, f"in all: {total}{slow}"])


@promoted
def plan(
    scene: Scene,
    *,
    environments: Sequence[Environment] | None = None,
    error: float | None = None,
    rate: float = 30.0,
    refine: bool | float = True,
    path: str | os.PathLike | None = None,
    progress: blocks.Progress = True,
) -> Plan:
    """Chooses a system for each part of a scene: the one with the fewest bytes that meets an error and a frame rate.

    A candidate must have an error below `error` / 1.25 under the given lights. The margin is for lights and views that
    were not measured. It holds for lights of the same kind: a plan made for an overcast sky says nothing about a sun.
    If no system reaches the frame rate, the fastest is chosen, and the table says so.

    Errors, times and bytes are those of direct light. The plan also chooses the number of bounces: the smallest number
    that omits at most `error` of the radiance of every part, or "all" if two bounces omit more.

    Args:
        scene: The scene.
        environments: Environments under which the error must hold, all of one size. If None, those of the scene, or the
            two built-in ones if it has none.
        error: Largest relative L2 error of the radiance of each part, at the vertices and between them. It does not
            include shadows that are finer than the triangles; see `GroupPlan.mesh_error`. If None, it is 0.05 for each
            part where a system reaches that. For other parts the system with the smallest error is chosen, with a
            warning.
        rate: Frames per second for the whole scene, each with a new light and a new view, without rasterization.
        refine: Whether meshes are divided first, and to which error, as in `jaxprt.precompute`.
        path: Folder in which measurements are stored. A call that was interrupted resumes from there.
        progress: Whether to show a progress bar, or a function; see `jaxprt.Run`.

    Returns:
        The plan, for `jaxprt.precompute(scene, system=plan.recipes, bounces=plan.bounces)`.

    Raises:
        TypeError: `scene` is not a `Scene`, or `environments` is not a list of `Environment`.
        ValueError: There are no lights, or lights of different sizes; a light or the result of a BRDF is not finite;
            `error` or `rate` is not positive and finite; or no system meets the given error for some part. The message
            then gives the smallest error that can be met.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    run = Run(path, progress=progress)
    named, environments = environments, lights_of(scene) if environments is None else environments
    asked = ERROR if error is None else error
    size, key = check_lights(environments, asked, rate), key_of(centered(scene), environments)
    options = {"vertices": None, "environments": named, "folder": None, "progress": progress}
    scene = centered(refinement.divided(sides.two_sided(scene), refine, **options)[0])
    mesh, views = scene.mesh, views_around(scene.mesh)
    total, plans = len(mesh.position), []
    looks = channels.looks(scene.parts)
    shadings = [channels.of_part(part, look=look) for part, look in zip(scene.parts, looks, strict=True)]
    parts = groups.kinds(shadings, [Lobes()] * len(shadings))
    for number, group in enumerate(blocks.tracked(parts, progress, "plan", unit="group")):
        members, names = [scene.parts[part] for part in group], tuple(scene.names[part] for part in group)
        sample = Sample.make(members, [shadings[part] for part in group], mesh, total, size, environments, views)
        count = len(sample.shading.mesh.position)
        alone = None
        if len(group) == 1:
            alone = sample.alone(members[0], channels.of_part(members[0], look=looks[group[0]], takes=Terms().takes))
        considered = tuple(_candidates(sample, alone, run.within(f"{key}_{number}"), asked, count / total / rate))
        good = [candidate for candidate in considered if candidate.error * MARGIN <= asked]
        if not good:
            best = min(considered, key=operator.attrgetter("error"))
            _report_miss(names, best, error)
            good = [best]
        fast = [candidate for candidate in good if candidate.seconds <= count / total / rate]
        chosen = min(fast, key=operator.attrgetter("nbytes")) if fast else min(good, key=operator.attrgetter("seconds"))
        plans.append(GroupPlan(names, count, sample.mesh_error, chosen, considered))
    reflected = reflection.fractions(shadings, environments, opacity=mesh.opacity, point_lights=scene.point_lights)
    bounces = reflection.needed(reflected, asked)
    return Plan(tuple(scene.names), tuple(plans), reflected, bounces, float(asked), float(rate), size, key)


def _report_miss(names: Sequence[str], best: Candidate, error: float | None) -> None:
    """Refuses a group for which no system meets a given error; warns if none was given."""
    least = best.error * MARGIN
    name = f"part {names[0]!r}" if len(names) == 1 else f"parts {', '.join(map(repr, names))}"
    if error is not None:
        raise ValueError(
            f"error must be at least {least:.3g} for {name}, which {best.recipe} reaches; got {error}. "
            "Ask for a larger error, or name a system"
        )
    warnings.warn(
        f"no system reaches an error of {100 * ERROR:g} % for {name}: {best.recipe} is chosen, which reaches "
        f"{100 * least:.1f} %",
        stacklevel=3,
    )


def key_of(scene: Scene, environments: Sequence[Environment]) -> str:
    """Fingerprint of a scene and its lights: meshes, classes and parameters of materials, textures, and radiance.

    A function is identified by its qualified name only, which is the same in another process.
    """
    leaves, structure = jax.tree.flatten((scene, tuple(environments)))
    arrays = [leaf for leaf in leaves if not callable(leaf)]
    functions = [getattr(leaf, "__qualname__", type(leaf).__qualname__) for leaf in leaves if callable(leaf)]
    kinds = re.sub(r" at 0x[0-9a-f]+", "", f"{structure} {functions}")  # without the addresses of static functions
    return blocks.fingerprint(np.frombuffer(kinds.encode(), np.uint8), *arrays)


def _candidates(sample: Sample, alone: Sample | None, run: Run, error: float, seconds: float):
    """Measures candidates of each system: a bisection along its steps, to the first that meets the error."""
    # `alone` is the sample with a BRDF that can be factored; None for groups without such a BRDF.
    ladders = [_ladder(recipe, sample, alone) for recipe in registry.systems().values()]
    most = math.inf  # largest number of bytes that is worth measuring
    for ladder in filter(None, ladders):
        least = [sample.least_bytes(recipe) for recipe, _ in ladder]
        low, high = 0, sum(count <= most for count in least)
        while low < high:  # Assumption: from one step to the next, the error decreases by at most half.
            middle = (low + high) // 2
            recipe, taker = ladder[middle]
            candidate = _measure(taker, recipe, run)
            yield candidate
            if candidate.error * MARGIN > error:
                halvings = math.log2(min(candidate.error, 1e6) * MARGIN / error)
                low = middle + max(1, int(halvings))
                if most == math.inf:  # No candidate meets the error yet: measure the last step too, for the message.
                    low = min(low, max(middle + 1, len(ladder) - 1))
                continue
            high, fast = middle, candidate.seconds <= seconds
            most = min(most, candidate.nbytes if fast else _SLOW * candidate.nbytes)
            if fast and least[0] > (1 - _SAVING) * candidate.nbytes:
                break


def _ladder(recipe: Recipe, sample: Sample, alone: Sample | None) -> list[tuple[Recipe, Sample]]:
    """The steps of a recipe, each with the sample whose BRDF it takes: that of the group, or of its only part alone."""
    table, steps = sample.shading.table, recipe.steps(sample.shading)
    if recipe.joins and (table is None or recipe.takes(table)):
        return [(step, sample) for step in steps if table is None or step.takes(table)]
    return [] if alone is None else [(step, alone) for step in steps]


def _measure(sample: Sample, recipe: Recipe, run: Run) -> Candidate:
    """Measures a candidate, or loads its measurement from a folder."""
    if run.path is None:
        return sample.measure(recipe)
    path = pathlib.Path(run.path, re.sub(r"\W+", "_", str(recipe)))
    if not path.exists():
        objects.save(path, sample.measure(recipe))
    candidate = objects.load(path)
    if not isinstance(candidate, Candidate):
        raise ValueError(f"{path} is damaged: it must hold a candidate, got a {type(candidate).__name__}; delete it")
    return candidate
