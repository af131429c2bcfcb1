"""What do gradients cost beside what they are of, by light, material and eye, in each system?

    python -m benchmarks.gradients [--quick] [--output FILE]

`seconds` is for a weighted sum of all vertices' radiance and its gradient, together; `peer` is the radiance alone, and
`cost` the one over the other. Both are as a user calls them: the gradient inside one `jit`, radiance as each system is
quickest. `hessian` lines have the product of the Hessian of the squared radiance, by the light, with a direction.

`error` is that of the slope along a random direction against differences of fourth order, in float64 on a few vertices.

Visibility and transport are random numbers on 36,000 random vertices, which is harder on caches than a mesh.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

import jaxprt as prt
from benchmarks import harness, relight_separable
from benchmarks.device import OneGroup
from jaxprt import bounces, brdf, bright_texels
from jaxprt import dynamic as dynamic_system
from jaxprt import harmonic as harmonic_system
from jaxprt import lobe as lobe_system
from jaxprt import separable as separable_system
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene.environment import Environment
from jaxprt.sphere import directions
from jaxprt.systems import standard
from jaxprt.systems.bounces import SecondBounce, TransferTensor
from jaxprt.systems.dynamic import DynamicTransport
from jaxprt.systems.harmonic import TransferMatrix
from jaxprt.systems.lobe import LobeTransport
from jaxprt.systems.separable import ClusteredTransport, SeparableBrdf

VERTICES = 36_000
MEMBERS = 225
SIZE = 64
TEXELS = 16
STEP = 1e-4  # of differences, relative, times 1e-2 and 2e-2


class Case(NamedTuple):
    """A system and what its radiance depends on.

    Attributes:
        radiance: Of the arguments, by name: light, material, eye.
        argument: Those.
        bytes: Of transport.
    """

    radiance: Callable[..., jax.Array]
    argument: dict[str, PyTree]
    bytes: int


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    vertices, repeats = (2 * MEMBERS, 3) if arguments.quick else (VERTICES, 15)
    for system, make in list(SYSTEMS.items())[: 1 if arguments.quick else None]:
        case = make(vertices)
        with jax.enable_x64(True):
            small = make(2 * MEMBERS)
        for name in case.argument:
            for line in measure(system, case, small, name, repeats):
                harness.report(line, arguments.output)


def measure(system: str, case: Case, small: Case, name: str, repeats: int):
    """Lines of one argument."""
    shape = jax.eval_shape(lambda: case.radiance(**case.argument)).shape
    weight = jax.random.normal(jax.random.key(3), shape)

    # All arrays are arguments: as constants they would be folded into the program.
    @jax.jit
    def slope(moved, other, weight):
        return jax.value_and_grad(lambda moved: jnp.vdot(case.radiance(**{name: moved}, **other), weight))(moved)

    @jax.jit
    def curved(moved, other, along):
        def squared(moved):
            return jnp.sum(case.radiance(**{name: moved}, **other) ** 2) / 2

        return jax.jvp(jax.grad(squared), (moved,), (along,))[1]

    moved = case.argument[name]
    other = {key: value for key, value in case.argument.items() if key != name}
    along = random_like(moved)
    common: dict[str, Any] = {"benchmark": "gradients", "bytes": case.bytes, "vertices": shape[0]}
    common |= {"error": disagreement(small, name), "peer": "radiance", "peer_error": 0.0}
    kinds = {"gradient": lambda: slope(moved, other, weight)}
    if name == "light":
        kinds["hessian"] = lambda: curved(moved, other, along)
    for kind, function in kinds.items():
        mine, alone = harness.compare(function, lambda: case.radiance(**case.argument), repeats=repeats)
        times = {**mine.line(), **alone.peer(), "cost": mine.seconds / alone.seconds}
        yield {**common, "case": f"{system}: {kind} by {name}, {shape[0]} vertices", **times}


def disagreement(case: Case, name: str) -> float:
    """Relative difference of a slope from differences, in double precision."""
    with jax.enable_x64(True):
        argument = jax.tree.map(wide, case.argument)
        shape = jax.eval_shape(lambda: case.radiance(**argument)).shape
        weight = jax.random.normal(jax.random.key(3), shape)
        along = jax.tree.map(lambda x, d: STEP * jnp.abs(x) * d, argument[name], random_like(argument[name]))

        def value(step):
            moved = jax.tree.map(lambda x, d: x + step * d, argument[name], along)
            return jnp.vdot(case.radiance(**{**argument, name: moved}), weight)

        exact = jax.grad(value)(0.0)
        tangent = jax.jvp(value, (0.0,), (1.0,))[1]
        near, far = ((value(h) - value(-h)) / (2 * h) for h in (1e-2, 2e-2))
        expected = (4 * near - far) / 3
        return float(max(abs(exact - expected), abs(tangent - expected)) / abs(expected))


def wide(array: jax.Array) -> jax.Array:
    """The same in double precision."""
    return jnp.asarray(np.asarray(array), jnp.float64) if jnp.issubdtype(array.dtype, jnp.floating) else array


def random_like(tree: PyTree) -> PyTree:
    """Normal random numbers."""
    leaf, structure = jax.tree.flatten(tree)
    keys = jax.random.split(jax.random.key(4), len(leaf))
    return structure.unflatten([jax.random.normal(k, x.shape, x.dtype) for k, x in zip(keys, leaf, strict=True)])


def separable(vertices: int) -> Case:
    """Four terms of 96 coefficients."""
    return _terms(relight_separable.synthetic(vertices).with_transpose(), 4)


def clustered(vertices: int) -> Case:
    """Thirty-two terms, 16 components, 64 modes, 768 coefficients."""
    return _terms(_clustered(vertices, terms=32, components=16, modes=64, keep=768), 32)


def harmonic(vertices: int) -> Case:
    """Transfer matrices of 25 coefficients."""
    position, frame = points(vertices)
    table = harmonic_system.tabulate(AshikhminShirley(nu=12.0, nv=4.0), degree=4)
    matrix = jax.random.normal(jax.random.key(1), (vertices, 1, 25, 25))
    transport = TransferMatrix(matrix, position, frame)
    leaf, structure = jax.tree.flatten(table)

    def radiance(light, material, eye):
        return prt.radiance(harmonic_system.HarmonicSystem(transport, structure.unflatten(material)), light, eye=eye)

    light = jax.random.normal(jax.random.key(0), (25, 3))
    return Case(radiance, {"light": light, "material": leaf, "eye": EYE}, matrix.nbytes)


def lobe(vertices: int) -> Case:
    """Eight lobes, tabulated over roughness, and sixteen texels."""
    transport = _seen(vertices)
    table = lobe_system.tabulate(lambda m: brdf.CookTorrance(roughness=m), lobes=8, knot=[np.array([0.15, 0.2, 0.3])])

    def radiance(light, material, eye):
        texel, excess, rest = bright_texels.split(Environment(light), count=TEXELS)
        color = prt.radiance(lobe_system.LobeSystem(transport, table.at(material)), rest, eye=eye)
        model = brdf.CookTorrance(roughness=material)
        return color + bright_texels.radiance(transport, model, texel, excess, eye=eye)

    return Case(radiance, {"light": sky(), "material": jnp.array(0.22), "eye": EYE}, transport.nbytes)


def dynamic(vertices: int) -> Case:
    """Direct light on Cook-Torrance's model, with twelve lobes, a tensor and sixteen texels."""
    transport, system = _dynamic(vertices)

    def radiance(light, material, eye):
        return prt.radiance(system, Environment(light), eye=eye, materials=mixed(material, vertices))

    return Case(radiance, arguments(), transport.nbytes)


def transfer(vertices: int) -> Case:
    """The same with one bounce and two."""
    transport, system = _dynamic(vertices)
    brdf, sent = standard.COOK_TORRANCE.paths()
    place = transport.position, transport.frame
    group = bounces.ReflectingPart(*place, standard.COOK_TORRANCE.harmonics(3), sent=sent)
    tensor = _bounces(vertices, bounces.functions.fixed_weights(brdf))
    reflected = OneGroup(bounces.GroupBounces.make(tensor, [group], [np.arange(vertices)]))

    def radiance(light, material, eye):
        both = prt.total(system, reflected)
        return prt.radiance(both, Environment(light), eye=eye, materials=mixed(material, vertices))

    return Case(radiance, arguments(), transport.nbytes + tensor.nbytes)


def _dynamic(vertices: int) -> tuple[DynamicTransport, bright_texels.BrightTexels]:
    """Random transport, and the system of Cook-Torrance's model."""
    table = standard.COOK_TORRANCE
    seen = _seen(vertices)
    terms = _clustered(vertices, terms=table.tensor().terms + 1, components=24, modes=128, keep=1024)
    transport = DynamicTransport(terms, seen)
    system = dynamic_system.DynamicSystem(transport, table.tensor())
    return transport, bright_texels.BrightTexels(system, seen, table.family, count=TEXELS)


def mixed(material, vertices: int) -> prt.Blend:
    """A material of diffuse and specular colors, Fresnel reflectance and roughness: base, mirror and rim."""
    diffuse, specular, (f0, roughness) = material
    weight = jnp.stack([diffuse, f0 * specular, (1 - f0) * specular]) / standard.COOK_TORRANCE.scale[:, None]
    parameter = jnp.broadcast_to(jnp.log(roughness), vertices)
    return prt.Blend(jnp.broadcast_to(weight, (vertices, 3, 3)), (parameter,))


def arguments() -> dict[str, PyTree]:
    """What all materials of the dynamic system can be differentiated in."""
    material = (jnp.array([0.3, 0.2, 0.1]), jnp.array([0.5, 0.6, 0.7]), jnp.array([0.4, 0.15]))
    return {"light": sky(), "material": material, "eye": EYE}


def points(vertices: int) -> tuple[jax.Array, jax.Array]:
    """Vertices on a sphere, and their frames."""
    normal = directions.normalize(jax.random.normal(jax.random.key(0), (vertices, 3)))
    return normal, directions.frame(normal, directions.tangent(normal))


def sky() -> jax.Array:
    """Light with a few bright texels."""
    return jax.random.lognormal(jax.random.key(5), 2.0, (6, SIZE, SIZE, 3))


def _terms(transport, terms: int) -> Case:
    factored = separable_system.factor(AshikhminShirley(), terms=terms)

    def radiance(light, material, eye):
        own = SeparableBrdf(factored.light_map, material, factored.error, factored.coordinates)
        return prt.radiance(separable_system.SeparableSystem(transport, own), Environment(light), eye=eye)

    return Case(radiance, {"light": sky(), "material": factored.view_map, "eye": EYE}, transport.nbytes)


def _clustered(vertices: int, *, terms: int, components: int, modes: int, keep: int) -> ClusteredTransport:
    clusters, random = vertices // MEMBERS, np.random.default_rng(0)
    position, frame = points(vertices)
    index = random.integers(0, 6 * SIZE * SIZE, (clusters, keep), dtype=np.uint16)
    mode, core, weight = (
        random.standard_normal(shape, dtype=np.float32)
        for shape in ((clusters, keep, modes), (clusters, modes, components, terms), (clusters, MEMBERS, components))
    )
    half = jnp.asarray(mode, jnp.float16), jnp.asarray(core, jnp.float16)
    row = jnp.arange(vertices)
    rms = jnp.ones(6 * SIZE * SIZE)
    return ClusteredTransport(jnp.asarray(index), *half, jnp.asarray(weight), position, frame, row, row, rms)


def _seen(vertices: int) -> LobeTransport:
    position, frame = points(vertices)
    count = lobe_system.pyramid.scales(SIZE).total
    pyramid = np.random.default_rng(1).integers(0, 256, (vertices, count), dtype=np.uint8)
    vector = np.random.default_rng(2).integers(0, 256, (lobe_system.diffuse.count(SIZE), vertices), dtype=np.uint8)
    return LobeTransport(jnp.asarray(pyramid), jnp.asarray(vector), position, frame, SIZE)


def _bounces(vertices: int, factor: jax.Array) -> TransferTensor:
    clusters, functions, random = vertices // MEMBERS, len(factor), np.random.default_rng(2)
    weight, mode, again = (
        random.standard_normal(shape, dtype=np.float32)
        for shape in ((clusters, MEMBERS, 32), (clusters, 384, 64), (clusters, MEMBERS, 16))
    )
    first, second = (
        jnp.asarray(random.standard_normal(shape, dtype=np.float32), jnp.float16)
        for shape in ((clusters, 64, 32, 16, functions), (clusters, 24, 16, 16, functions, functions))
    )
    row, wrong = jnp.arange(vertices), jnp.zeros(clusters)
    twice = SecondBounce(jnp.asarray(again), second, wrong)
    known = (row, jnp.zeros_like(row), jnp.ones(vertices), jnp.arange(functions), (factor,), twice, wrong, jnp.ones(2))
    return TransferTensor(jnp.asarray(weight), first, jnp.asarray(mode), *known)


EYE = jnp.array([2.0, 1.0, 3.0])
SYSTEMS = {each.__name__: each for each in (separable, clustered, harmonic, lobe, dynamic, transfer)}

if __name__ == "__main__":
    main()
