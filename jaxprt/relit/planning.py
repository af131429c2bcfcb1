"""An error in, a plan out: for each part of a scene the system and the sizes that meet an error with the fewest bytes.

Recipes of all systems are carried out for a sample of each part's vertices and judged by the exact sum, from eight
views, under every light. Bytes and times are those of the sample, scaled to the part.
"""

import math
import os
import pathlib
import re
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
import tqdm
from jaxtyping import Float

from jaxprt import require
from jaxprt.brdf import Lambert
from jaxprt.files import objects
from jaxprt.relit import reflection
from jaxprt.relit.channels import of_part
from jaxprt.relit.measuring import checked, lights_of, views_around
from jaxprt.relit.recipes import Clusters, Harmonics, Lobes, Recipe
from jaxprt.relit.sampling import MEMBERS, Candidate, Sample
from jaxprt.scene import Environment, Scene
from jaxprt.visibility import blocks

MARGIN = 1.25  # plans are made for an error smaller by this factor: lights and views that they did not see differ
_SAVING = 0.1  # of the bytes: what is worth measuring another candidate for
_SLOW = 2.0  # times the bytes of what is too slow may be measured for what is faster

# Steps up in size, the cheapest first. Terms, resolution, components, modes, coefficients and texels are in balance.
_DIFFUSE = tuple(Harmonics(degree=degree) for degree in (2, 3, 4, 6, 8))
_HARMONIC = tuple(Harmonics(degree=degree) for degree in (2, 3, 4))
_LOBES = tuple(Lobes(*each) for each in ((2, 4), (4, 8), (8, 16), (12, 16), (16, 32), (24, 64)))
_SIZES = (
    (2, 64, 4, 8, 192, 2),
    (4, 64, 8, 24, 256, 4),
    (8, 64, 8, 32, 384, 4),
    (16, 64, 12, 48, 512, 8),
    (32, 64, 16, 80, 768, 16),
    (48, 64, 16, 96, 1024, 16),
    (64, 64, 24, 128, 1024, 32),
    (96, 96, 32, 192, 1536, 64),
    (128, 96, 48, 256, 1536, 64),
    (192, 96, 64, 384, 2048, 128),
)
_TERMS = tuple(Clusters(*each, members=MEMBERS) for each in _SIZES)


class PartPlan(eqx.Module):
    """The plan of one part.

    Attributes:
        name: Name of the part.
        vertices: Number of its vertices.
        chosen: What was chosen.
        considered: All that was measured, in this order.
        mesh_error: Relative L2 error that the mesh adds under the worst of the lights, whatever the system: shadows
            finer than its triangles.
    """

    name: str
    vertices: int
    mesh_error: float
    chosen: Candidate
    considered: tuple[Candidate, ...]


class Plan(eqx.Module):
    """The plan of a scene; `print` shows its decisions as a table.

    Attributes:
        part: One plan for each part of the scene.
        reflected: Fraction of each part's radiance that other surfaces reflected at least once (row 0), twice (row 1)
            and three times (row 2): relative L2, estimated for matte surfaces.
        bounces: As many as leave no more than the error of any part's light out: 0, 1, 2 or "all".
        asked: The error that was asked for.
        rate: Frames per second that were asked for.
        size: Edge of the lights' cubemap faces in texels.
        key: Fingerprint of the scene and the lights, by which the plan of others is refused.
    """

    part: tuple[PartPlan, ...]
    reflected: Float[np.ndarray, "b p"]
    bounces: int | str
    asked: float
    rate: float
    size: int
    key: str

    @property
    def error(self) -> float:
        """Predicted relative L2 error of the part that is farthest off."""
        return max(each.chosen.error for each in self.part)

    @property
    def seconds(self) -> float:
        """Time of a frame with new light and new view on this machine, without drawing."""
        return sum(each.chosen.seconds for each in self.part)

    @property
    def nbytes(self) -> int:
        """Size of transport and BRDFs in bytes, without those of bounces."""
        return sum(each.chosen.nbytes for each in self.part)

    @property
    def recipes(self) -> dict[str, Recipe]:
        """The recipe of each part, for `jaxprt.precompute`."""
        return {each.name: each.chosen.recipe for each in self.part}

    def __str__(self) -> str:
        """The table of what was considered; a star marks what was chosen."""
        rows = [f"error asked {100 * self.asked:g} %, {self.rate:g} frames per second"]
        for part in self.part:
            rows.append(f"{part.name}: {part.vertices} vertices")
            chosen = repr(part.chosen.recipe)  # A plan that was saved has a copy of it among those considered.
            rows += [f"  {'*' if repr(each.recipe) == chosen else ' '} {each}" for each in part.considered]
            advice = "; `jaxprt.refine` divides its triangles" if part.mesh_error > self.asked else ""
            rows.append(f"    {100 * part.mesh_error:.1f} % of shadows between its vertices{advice}")
        for part, (once, twice, often) in zip(self.part, 100 * self.reflected.T, strict=True):
            rows.append(
                f"{part.name}: {once:.1f} % of its light is reflected, {twice:.1f} % twice or more, "
                f"{often:.1f} % three times or more"
            )
        rows.append(f"bounces: {self.bounces}")
        total = f"{100 * self.error:.1f} %, {1e3 * self.seconds:.1f} ms a frame, {self.nbytes / 1e6:.2f} MB"
        slow = "" if self.seconds * self.rate <= 1 else f"; slower than the {self.rate:g} frames per second asked for"
        return "\n".join([*rows, f"in all: {total}{slow}"])


def plan(
    scene: Scene,
    *,
    environments: Sequence[Environment] | None = None,
    error: float = 0.05,
    rate: float = 30.0,
    path: str | os.PathLike | None = None,
    progress: bool = True,
) -> Plan:
    """Chooses for each part of a scene the system that meets an error at a rate with the fewest bytes.

    The plan takes the cheapest sizes of each system whose error is below `error` / 1.25. Under lights and from views
    that it did not see, the error is then below `error` if they are of the same kind: a plan made under an overcast sky
    promises nothing for a sun. If no system reaches the rate, the fastest one is taken, and the table says so.

    Errors, times and bytes are those of direct light. Light that the parts reflect onto each other is left out if it is
    less than `error` of every part's; else the plan asks for as many bounces as leave no more out, and for all if two
    leave out more.

    Args:
        scene: The scene.
        environments: Lights that the error must hold for, of one size; the scene's own, or else the two embedded ones.
        error: Relative L2 error of the radiance of each part, between its vertices too, as pictures show it, but for
            shadows that are finer than the triangles: `PartPlan.mesh_error`.
        rate: Frames per second with new light and new view, for the scene as a whole, without drawing.
        path: Folder that keeps what was measured; a call that was stopped, or killed, goes on from there.
        progress: Whether to show a progress bar.

    Returns:
        The plan, for `jaxprt.precompute(scene, system=plan.recipes, bounces=plan.bounces)`.

    Raises:
        TypeError: No scene.
        ValueError: No lights, lights of different sizes, NaN or infinity in them or from a BRDF, an error or a rate
            that is not positive and finite, or an error that no system reaches for some part; the message has the best.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    environments = lights_of(scene) if environments is None else environments
    size = checked(environments, error, rate)
    mesh, views = scene.mesh, views_around(scene.mesh)
    total, parts = len(mesh.position), []
    shadings, key = [of_part(part) for part in scene.parts], key_of(scene, environments)
    pairs = enumerate(zip(scene.parts, shadings, strict=True))
    for number, (part, shading) in tqdm.tqdm(
        pairs, desc="plan", unit="part", total=len(shadings), disable=not progress
    ):
        sample = Sample.make(part, shading, mesh, total, size, environments, views)
        count = len(part.mesh.position)
        kept = None if path is None else pathlib.Path(path) / f"{key}_{number}"
        considered = tuple(_considered(sample, kept, error, count / total / rate))
        good = [each for each in considered if each.error * MARGIN <= error]
        if not good:
            best = min(considered, key=lambda each: each.error)
            raise ValueError(
                f"error must be at least {best.error * MARGIN:.3g} for part {part.name!r}, which "
                f"{best.recipe} reaches; got {error}"
            )
        fast = [each for each in good if each.seconds <= count / total / rate]
        chosen = min(fast, key=lambda each: each.nbytes) if fast else min(good, key=lambda each: each.seconds)
        parts.append(PartPlan(part.name, count, sample.mesh_error, chosen, considered))
    reflected = reflection.fractions(shadings, environments)
    bounces = reflection.needed(reflected, error)
    return Plan(tuple(parts), reflected, bounces, float(error), float(rate), size, key)


def key_of(scene: Scene, environments: Sequence[Environment]) -> str:
    """Fingerprint of a scene and its lights: meshes, classes and parameters of materials, textures, radiance.

    A function counts by its qualified name alone, which another process finds again.
    """
    leaves, structure = jax.tree.flatten((scene, tuple(environments)))
    arrays = [each for each in leaves if not callable(each)]
    functions = [getattr(each, "__qualname__", type(each).__qualname__) for each in leaves if callable(each)]
    kinds = re.sub(r" at 0x[0-9a-f]+", "", f"{structure} {functions}")  # without addresses of static functions
    return blocks.fingerprint(np.frombuffer(kinds.encode(), np.uint8), *arrays)


def _considered(sample: Sample, folder: pathlib.Path | None, error: float, seconds: float):
    """Candidates of each system: by bisection, those around the first step of its ladder that meets the error.

    Left out are steps that must have more bytes than what meets the error already, twice as many if that is too slow;
    those that are too near to one that misses the error by far; and smaller ones that could not save a tenth.
    """
    if isinstance(sample.shading.brdf, Lambert):
        ladders: list[tuple] = [_DIFFUSE]
    else:
        ladders = [_HARMONIC, _LOBES] + ([] if sample.shading.knot else [_TERMS])
    most = math.inf  # bytes of what is worth measuring
    for ladder in ladders:
        least = [sample.least_bytes(recipe) for recipe in ladder]
        low, high = 0, sum(each <= most for each in least)
        while low < high:  # Errors fall along a ladder, at most by half from step to step.
            middle = (low + high) // 2
            each = _measured(sample, ladder[middle], folder)
            yield each
            if each.error * MARGIN > error:
                halvings = math.log2(min(each.error, 1e6) * MARGIN / error)
                low = middle + max(1, int(halvings))
                if most == math.inf:  # Nothing meets the error yet: the best must be known.
                    low = min(low, max(middle + 1, len(ladder) - 1))
                continue
            high, fast = middle, each.seconds <= seconds
            most = min(most, each.nbytes if fast else _SLOW * each.nbytes)
            if fast and least[0] > (1 - _SAVING) * each.nbytes:
                break


def _measured(sample: Sample, recipe: Recipe, folder: pathlib.Path | None) -> Candidate:
    """What a recipe brings and costs, kept in a folder."""
    if folder is None:
        return sample.measure(recipe)
    path = folder / re.sub(r"\W+", "_", str(recipe))
    if not path.exists():
        objects.save(path, sample.measure(recipe))
    return objects.load(path)
