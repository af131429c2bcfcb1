"""What does each step of relighting cost on a device, how near to reading its arrays, how far from the CPU's answer?

    python -m benchmarks.device [--quick] [--vertices N ...] [--output FILE]

All run-time steps of all systems, on random transport of the shapes that real ones have: no rays, no files, no meshes
but a torus that is drawn. `device` is the first one of JAX, a GPU where there is one; `error` is the relative L2
distance of what a step makes there from what the same step makes of the same arrays on the CPU. `peer` is a plain read
of the arrays that a step depends on, `bytes`, on the device itself: `ratio` is the part of the memory's bandwidth that
the step reaches, and more than 1 where it gathers little out of much. A system that would take more than a third of the
host's memory has fewer vertices than `asked`.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from benchmarks import harness
from benchmarks.published.quantized import quantize
from benchmarks.rasterize import facing, torus
from benchmarks.relight_separable import synthetic
from jaxprt import Blend, System, bounces, bright_texels, dynamic, harmonic, lobe, memory, separable
from jaxprt.brdf import CookTorrance
from jaxprt.image import rasterize, resolve, shading_points
from jaxprt.scene import Environment, Mesh
from jaxprt.scene.points import VERTICES, Points
from jaxprt.sphere import directions

SIZES = 36_000, 300_000, 1_000_000
MEMBERS = 225  # vertices of a cluster
EYE = np.array([0.5, 1.0, 4.0], np.float32)


class Step(NamedTuple):
    """A step: its name, the function, and its arguments on the host."""

    name: str
    function: Callable
    arguments: tuple


class Maker:
    """Random arrays of real shapes, on the host.

    Attributes:
        size: Edge of the light's faces in texels.
        picture: Edge of the picture in pixels.
    """

    def __init__(self, *, size: int, picture: int):
        self.size, self.picture = size, picture
        self.random = np.random.default_rng(0)

    def normal(self, *shape: int) -> jax.Array:
        """Random values of either sign, of the order of 1."""
        return jnp.asarray(self.random.standard_normal(shape, np.float32))

    def half(self, *shape: int) -> jax.Array:
        """The same in half precision, block by block."""
        return jnp.asarray(
            np.stack([self.random.standard_normal(shape[1:], np.float32) for _ in range(shape[0])]), "f2"
        )

    def uniform(self, *shape: int) -> jax.Array:
        """Between .1 and .9."""
        return jnp.asarray(0.1 + 0.8 * self.random.random(shape, np.float32))

    def place(self, vertices: int) -> tuple[jax.Array, jax.Array]:
        """Positions on the unit sphere, and frames there."""
        position = directions.normalize(self.normal(vertices, 3))
        return position, directions.frame(position, directions.tangent(position))

    def light(self) -> Environment:
        """Soft light with bright texels."""
        return Environment(jnp.exp(2 * self.normal(6, self.size, self.size, 3)))

    def maps(self, terms: int) -> separable.SeparableBrdf:
        """A factored BRDF."""
        return separable.SeparableBrdf(self.normal(terms, 48, 48, 1), self.normal(terms, 48, 48, 3), jnp.asarray(0.0))

    def lobes(self, *members: int, count: int = 8) -> lobe.LobeBrdf:
        """A table of lobes, for a set one for each member."""
        up = np.abs(self.random.standard_normal((3, count, *members, 64))) + 0.3
        mean = jnp.asarray(up / np.linalg.norm(up, axis=0), jnp.float32)
        knot = tuple(jnp.arange(each, dtype=jnp.float32) for each in members)
        scale, weight = 10 * self.uniform(count, *members, 64), self.uniform(3, count, *members, 64)
        return lobe.LobeBrdf(mean, scale, weight, self.uniform(3, *members, 64), knot, jnp.asarray(0.0))

    def pyramids(self, vertices: int, *, diffuse: bool = True) -> lobe.LobeTransport:
        """Visibility at all scales, with or without vectors for diffuse light."""
        shape = vertices, lobe.pyramid.scales(self.size).total
        seen = jnp.asarray(self.random.integers(256, size=shape, dtype=np.uint8))
        shape = lobe.diffuse.count(self.size) if diffuse else 0, vertices
        vector = jnp.asarray(self.random.integers(256, size=shape, dtype=np.uint8))
        return lobe.LobeTransport(seen, vector, *self.place(vertices), self.size)

    def clusters(self, vertices: int, terms: int, *, modes: int = 96, components: int = 16) -> Any:
        """Clustered transport."""
        count, texels = -(-vertices // MEMBERS), 6 * self.size**2
        keep = min(1024, texels)
        index = np.stack([self.random.permutation(texels)[:keep] for _ in range(count)]).astype(np.uint16)
        arrays = self.half(count, keep, modes), self.half(count, modes, components, terms)
        weight = self.normal(count, MEMBERS, components)
        row = np.arange(count * MEMBERS, dtype=np.int32)
        position, frame = self.place(vertices)
        vertex, place = jnp.asarray(row % vertices), jnp.asarray(row[:vertices])
        return separable.ClusteredTransport(
            jnp.asarray(index), *arrays, weight, position, frame, vertex, place, jnp.ones(texels)
        )

    def sparse(self, vertices: int) -> tuple[System, Any]:
        """Kept wavelets; of 6 x 64 x 64 whatever the size."""
        return separable.SeparableSystem(synthetic(vertices), self.maps(4)), None

    def quantized(self, vertices: int) -> tuple[System, Any]:
        """The same in whole numbers."""
        return separable.SeparableSystem(quantize(synthetic(vertices)), self.maps(4)), None

    def clustered(self, vertices: int) -> tuple[System, Any]:
        """Clusters of vertices, 32 terms."""
        return separable.SeparableSystem(self.clusters(vertices, 32), self.maps(32)), None

    def harmonics(self, vertices: int) -> tuple[System, Any]:
        """Transfer matrices of 25 harmonics."""
        transport = harmonic.TransferMatrix(self.normal(vertices, 1, 25, 25), *self.place(vertices))
        return harmonic.HarmonicSystem(
            transport, harmonic.HarmonicBrdf(self.normal(25, 3, 48), (), jnp.asarray(0.0))
        ), None

    def lobe(self, vertices: int) -> tuple[System, Any]:
        """Pyramids and eight lobes."""
        return lobe.LobeSystem(self.pyramids(vertices), self.lobes()), None

    def dynamic(self, vertices: int) -> tuple[dynamic.DynamicSystem, Any]:
        """A BRDF of three channels, with lobes and two terms."""
        maps = self.normal(2, 32, 32), self.normal(2, 32, 32)
        brdf = dynamic.DynamicBrdf(self.lobes(), self.normal(2, 2, 2), self.normal(3, 2), *maps, jnp.asarray(0.0))
        transport = dynamic.DynamicTransport(self.clusters(vertices, 3), self.pyramids(vertices))
        return dynamic.DynamicSystem(transport, brdf), Blend(self.uniform(vertices, 3, 3))

    def bounces(self, vertices: int) -> tuple[System, Any]:
        """One and two bounces of three path functions, the channels of one BRDF."""
        count = -(-vertices // MEMBERS)
        row = jnp.arange(vertices, dtype=jnp.int32)
        second = bounces.SecondBounce(
            self.normal(count, MEMBERS, 6), self.half(count, 24, 6, 16, 3, 3), jnp.zeros(count)
        )
        tensor = bounces.TransferTensor(
            self.normal(count, MEMBERS, 24),
            self.half(count, 24, 24, 16, 3),
            self.normal(count, 96, 24),
            row,
            0 * row,
            self.uniform(vertices),
            jnp.arange(3, dtype=jnp.int32),
            (jnp.eye(3),),
            second,
            jnp.zeros(count),
            jnp.ones(2),
        )
        table = harmonic.HarmonicBrdf(self.normal(16, 3, 48), (), jnp.asarray(0.0))
        group = bounces.ReflectingPart(*self.place(vertices), table)
        made = bounces.GroupBounces.make(tensor, [group], [np.asarray(row)])
        return OneGroup(made), Blend(self.uniform(vertices, 3, 3))


class OneGroup(System):
    """Reflected light alone, of a scene of one group. Materials are a `Blend`."""

    bounces: bounces.GroupBounces

    def light(self, environment: Environment) -> Any:
        """Applies the tensor to a light."""
        return self.bounces.light(environment)

    def shade(self, light: Any, materials: Any = None) -> Any:
        """Harmonics of the light that arrives at the vertices."""
        return self.bounces.shade(light, [materials])[0]

    def view(self, eye: jax.Array, materials: Any = None, points: Points = VERTICES) -> Any:
        """Harmonics of the BRDF."""
        return self.bounces.group[0].view(eye, materials, points)

    def combine(self, light: Any, view: Any, points: Points = VERTICES) -> jax.Array:
        """Radiance of reflected light."""
        return self.bounces.group[0].combine(light, view, points)

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return len(self.bounces.place)


SYSTEMS: dict[str, Callable[[Maker, int], tuple[System, Any]]] = {
    "sparse": Maker.sparse,
    "quantized": Maker.quantized,
    "clustered": Maker.clustered,
    "harmonic": Maker.harmonics,
    "lobe": Maker.lobe,
    "dynamic": Maker.dynamic,
    "bounces": Maker.bounces,
}


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--vertices", type=int, nargs="+", default=SIZES, metavar="N", help="sizes of the mesh")
    arguments = parser.parse_args(options)
    maker = Maker(size=8, picture=32) if arguments.quick else Maker(size=64, picture=512)
    for asked in [2 * MEMBERS] if arguments.quick else arguments.vertices:
        for name in (*SYSTEMS, "picture"):
            for line in measure(name, maker, asked, repeats=2 if arguments.quick else 20):
                harness.report(line, arguments.output)


def measure(name: str, maker: Maker, asked: int, repeats: int) -> Iterator[dict]:
    """The lines of a system, or of drawing, at one size."""
    device, host = jax.devices()[0], jax.devices("cpu")[0]
    with jax.default_device(host):
        vertices, steps = picture(maker, asked) if name == "picture" else verbs(name, maker, asked)
    for step in steps:
        with jax.default_device(device):
            given = jax.device_put(step.arguments, device)
            depends = read(step.function, given)
            mine, peer = harness.compare(
                lambda step=step, given=given: step.function(*given), reader(depends), repeats=repeats
            )
            made = step.function(*given)
        with jax.default_device(host):
            expected = step.function(*step.arguments)
        yield {
            "benchmark": "device",
            "case": f"{name} {step.name}, {vertices} vertices",
            **mine.line(),
            "error": distance(made, expected),
            "bytes": sum(each.nbytes for each in depends),
            "vertices": vertices,
            "asked": asked,
            "device": f"{device.platform}: {device.device_kind}",
            "peer": "plain read",
            "peer_seconds": peer.seconds,
            "peer_error": 0.0,
        }


def verbs(name: str, maker: Maker, asked: int) -> tuple[int, Iterator[Step]]:
    """The number of vertices that there is room for, and the verbs of a system, each made when its turn comes."""
    few = MEMBERS
    each = memory(SYSTEMS[name](maker, few)[0]) / few
    room = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 3
    vertices = min(asked, max(few, int(room / each)))
    return vertices, _verbs(*SYSTEMS[name](maker, vertices), maker)


def _verbs(system: System, materials: Any, maker: Maker) -> Iterator[Step]:
    environment = maker.light()
    if isinstance(system, separable.SeparableSystem):
        size = math.isqrt(len(system.transport.rms) // 6)
        environment = Environment(jnp.exp(2 * maker.normal(6, size, size, 3)))
    eye = jnp.asarray(EYE)
    yield Step("light", _light, (system, environment))
    light = system.light(environment)
    if type(system).shade is not System.shade:
        yield Step("shade", _shade, (system, light, materials))
    arriving = system.shade(light, materials)
    yield Step("view", _view, (system, eye, materials))
    yield Step("combine", _combine, (system, arriving, system.view(eye, materials)))
    if isinstance(system, lobe.LobeSystem):
        brdf = CookTorrance(diffuse=0.2, specular=0.5, roughness=0.2, f0=0.3)
        yield Step("bright texels split", _split, (environment,))
        texel, excess, _ = bright_texels.split(environment, count=16)
        yield Step("bright texels", _texels, (system.transport, brdf, texel, excess, eye))


def _light(system: System, environment: Environment) -> Any:
    return system.light(environment)


def _shade(system: System, light: Any, materials: Any) -> Any:
    return system.shade(light, materials)


def _view(system: System, eye: jax.Array, materials: Any) -> Any:
    return system.view(eye, materials)


def _combine(system: System, light: Any, view: Any) -> Any:
    return system.combine(light, view)


def _split(environment: Environment) -> Any:
    return bright_texels.split(environment, count=16)


def _texels(transport: Any, brdf: Any, texel: jax.Array, excess: jax.Array, eye: jax.Array) -> Any:
    return bright_texels.radiance(transport, brdf, texel, excess, eye=eye)


def picture(maker: Maker, asked: int) -> tuple[int, list[Step]]:
    """Drawing a torus, and putting the picture together of colors at its pixels."""
    rows = max(3, math.isqrt(asked))
    position, face = torus(rows, asked // rows)
    normal = directions.normalize(jnp.asarray(position, jnp.float32))
    region = jnp.zeros(len(position), jnp.int32)
    mesh = Mesh(jnp.asarray(position, jnp.float32), jnp.asarray(face, jnp.int32), normal, normal, region)
    camera = facing(position, maker.picture)
    pixels = shading_points(rasterize(mesh, camera, samples=4), mesh, camera)
    color = maker.uniform(len(pixels.triangle), 3)
    steps = [
        Step("rasterize", rasterize, (mesh, camera)),
        Step("rasterize 4 samples", lambda mesh, camera: rasterize(mesh, camera, samples=4), (mesh, camera)),
        Step("resolve", resolve, (pixels, color)),
    ]
    return len(position), steps


def read(function: Callable, arguments: tuple) -> list[jax.Array]:
    """The arrays among the arguments that the result depends on."""
    leaf, tree = jax.tree.flatten(arguments)
    program = jax.make_jaxpr(lambda *leaf: function(*tree.unflatten(leaf)))(*leaf)
    _, used = partial_eval.dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars))
    return [each for each, depends in zip(leaf, used, strict=True) if depends]


def reader(arrays: Sequence[jax.Array]) -> Callable[[], Any]:
    """A function that reads arrays once where they are."""
    if all(each.platform == "cpu" for array in arrays for each in array.devices()):
        return harness.reader([np.asarray(each) for each in arrays])
    program = jax.jit(lambda arrays: [jnp.max(each) for each in arrays if each.size])
    return lambda: program(arrays)


def distance(made: Any, expected: Any) -> float:
    """Relative L2 distance over all floating-point arrays, where both are finite."""
    square = np.zeros(2)
    for one, other in zip(jax.tree.leaves(made), jax.tree.leaves(expected), strict=True):
        if jnp.issubdtype(one.dtype, jnp.floating):
            one, other = np.asarray(one), np.asarray(other)
            known = np.isfinite(one) & np.isfinite(other)
            difference = np.where(known, one, 0) - np.where(known, other, 0)
            square += [np.sum(each**2, dtype=np.float64) for each in (difference, np.where(known, other, 0))]
    return float(np.sqrt(square[0] / square[1])) if square[1] else float(np.sqrt(square[0]))


if __name__ == "__main__":
    main()
