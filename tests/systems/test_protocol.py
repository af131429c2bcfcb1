"""What every system promises through its four methods, checked for all of them.

To add a system, add a line to ``SYSTEMS``: it gets a scene's name and makes a system, with its materials, for its mesh.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bright_texels, dynamic, harmonic, lobe, separable, visibility
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.scene import Environment, Mesh, builtin
from jaxprt.scene.mesh import grid_face, join, make_mesh, split
from jaxprt.scene.points import VERTICES, Points, on_triangles
from jaxprt.sphere import cubemap
from jaxprt.systems import protocol

pytestmark = pytest.mark.usefixtures("coarse")

SIZE = 8
EYE = jnp.array([1.5, 2.0, 2.5])
GLOSSY = CookTorrance(diffuse=0.5, specular=0.5, roughness=0.5, f0=0.4)
MODELS = {
    "white": Lambert(1.0),
    "glossy": GLOSSY,
    "channels": lambda wi, wo: jnp.concatenate([GLOSSY(wi, wo), 0.5 * GLOSSY(wi, wo), Lambert(1.0)(wi, wo)], -1),
}


class Case(NamedTuple):
    """A system, its materials, and the radiance that it stands for."""

    system: prt.System
    materials: Any
    mesh: Mesh


class Promise(NamedTuple):
    """How to make a system, and its tolerances.

    ``white``: relative, in a white furnace. ``error``: relative, against the exact sum. None skips the test. ``linear``
    systems add up lights exactly; those with bright texels choose which texels are bright.
    """

    make: Callable[[str, str], tuple[prt.System, Any]]
    white: float | None
    error: float | None
    linear: bool = True


@functools.cache
def seen(name: str) -> visibility.StoredVisibility:
    """What the vertices of a scene see; rays are traced once for all systems."""
    return visibility.precompute(mesh(name), size=SIZE)


@functools.cache
def mesh(name: str) -> Mesh:
    """Scenes: a sphere on a ground (two regions), a sphere of as many vertices or its inside, and one triangle."""
    if name == "triangle":
        return make_mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, -1]]), np.array([[0, 1, 2]]))
    if name.isdecimal():
        return hills(int(name))
    if name == "ball":
        return builtin.sphere(rings=10, sectors=11)
    if name == "inside":
        ball = builtin.sphere(rings=10, sectors=11)
        return make_mesh(np.asarray(ball.position), np.asarray(ball.face)[:, ::-1], normal=-np.asarray(ball.normal))
    ball = builtin.sphere(rings=6, sectors=10)
    floor = builtin.plane(cells=6)
    floor = eqx.tree_at(lambda m: m.position, floor, floor.position * 2 - jnp.array([0.0, 1.01, 0.0]))
    return join([ball, floor])


def hills(count: int) -> Mesh:
    """A hilly ground of exactly `count` vertices: a grid, and triangles above it."""
    side = int(np.sqrt(count))
    x, z = np.meshgrid(*[np.linspace(-2, 2, side)] * 2)
    height = 0.2 * np.sin(5 * x) * np.cos(4 * z)
    position, face = np.stack([x, height, z], -1).reshape(-1, 3), grid_face(rows=side, columns=side)
    rest = count - side**2
    if not rest:
        return make_mesh(position, face)
    corner = np.random.default_rng(0).uniform(-1, 1, (rest, 3)) + [0, 2, 0]
    above = np.minimum(np.arange(rest // 3 * 3 + 3 * (rest % 3 > 0)), rest - 1).reshape(-1, 3)
    return make_mesh(np.concatenate([position, corner]), np.concatenate([face, side**2 + above]))


@functools.cache
def factored(model: str) -> separable.SeparableBrdf:
    """Terms of a BRDF."""
    return separable.factor(MODELS[model], terms=6, resolution=16)


@functools.cache
def lobe_table(model: str) -> lobe.LobeBrdf:
    """Lobes of a BRDF."""
    return lobe.tabulate(MODELS[model], lobes=6, resolution=8)


@functools.cache
def harmonic_table(model: str) -> harmonic.HarmonicBrdf:
    """A BRDF in harmonics."""
    return harmonic.tabulate(MODELS[model], degree=4, error=0.5)


@functools.cache
def sparse(name: str, model: str) -> tuple[prt.System, Any]:
    brdf = factored(model)
    transport = separable.precompute(mesh(name), brdf, keep=6 * SIZE**2, size=SIZE)
    return separable.SeparableSystem(transport, brdf), None


def clustered(name: str, model: str) -> tuple[prt.System, Any]:
    brdf, visible = factored(model), seen(name)
    members = max(1, len(visible.position) // 24)
    sizes = {"clusters": members, "components": min(24, len(visible.position) // members), "modes": 64, "keep": 384}
    sizes["modes"] = min(sizes["modes"], sizes["components"] * brdf.terms)
    transport = separable.clustered.precompute(visible, brdf, **sizes)
    return separable.SeparableSystem(transport, brdf), None


def matrices(name: str, model: str) -> tuple[prt.System, Any]:
    transport = harmonic.precompute(mesh(name), degree=4, size=SIZE)
    return harmonic.HarmonicSystem(transport, harmonic_table(model)), None


def vectors(name: str, model: str) -> tuple[prt.System, Any]:
    transport = harmonic.precompute_diffuse(mesh(name), degree=4, size=SIZE)
    return harmonic.DiffuseSystem(transport, jnp.ones(1) if model == "white" else jnp.full(1, 0.5)), None


@functools.cache
def lobes(name: str, model: str) -> tuple[prt.System, Any]:
    return lobe.LobeSystem(lobe.compress(seen(name)), lobe_table(model)), None


def mattes(name: str, model: str) -> tuple[prt.System, Any]:
    transport = lobe.matte_transport(lobe.compress(seen(name)))
    return lobe.MatteSystem(transport, jnp.ones(1) if model == "white" else jnp.full(1, 0.5)), None


def bright(name: str, model: str) -> tuple[prt.System, Any]:
    system, _ = lobes(name, model)
    return bright_texels.BrightTexels(system, system.transport, MODELS[model], count=8), None


@functools.cache
def tensor(model: str) -> dynamic.DynamicBrdf:
    """A BRDF as few lobes and a tensor."""
    return dynamic.tabulate(MODELS[model], lobes=lobe_table(model), ranks=(2, 6, 6), resolution=16)


@functools.cache
def dynamics(name: str, model: str) -> tuple[prt.System, Any]:
    sizes = {"components": 16, "modes": 48, "keep": 384}
    transport = dynamic.compress(seen(name), tensor(model), **sizes)
    return dynamic.DynamicSystem(transport, tensor(model)), None


def of_parts(name: str, model: str, **options) -> tuple[prt.System, Any]:
    """A scene whose parts are the regions of a mesh, all with one BRDF."""
    parts = [prt.Part(str(n), part, MODELS[model]) for n, part in enumerate(split(mesh(name)))]
    recipe = prt.relit.Lobes(lobes=6, texels=0)
    return prt.precompute(prt.Scene(parts), refine=False, system=recipe, size=SIZE, progress=False, **options), None


def between_parts(name: str, model: str) -> tuple[prt.System, Any]:
    return of_parts(name, model, bounces=2, rays=0)


def total(name: str, model: str) -> tuple[prt.System, Any]:
    return prt.total(lobes(name, model)[0], mattes(name, model)[0]), None


SYSTEMS = {
    "separable": Promise(sparse, 0.01, 0.1),
    "separable, clustered": Promise(clustered, 0.02, 0.1),
    "harmonic": Promise(matrices, 0.02, 0.25),
    "harmonic, diffuse": Promise(vectors, 0.02, None),
    "lobe": Promise(lobes, 0.02, 0.1),
    "lobe, matte": Promise(mattes, 0.02, None),
    "lobe, bright texels": Promise(bright, 0.02, 0.1, linear=False),
    "dynamic": Promise(dynamics, 0.02, 0.1),
    "scene": Promise(of_parts, 0.02, 0.1),
    "scene with bounces": Promise(between_parts, None, None),
    "lobe and matte": Promise(total, None, None),
}
each_system = pytest.mark.parametrize("name", SYSTEMS)
LOOPS = ["separable", "dynamic", "scene with bounces"]  # They have all loops among them.


@functools.cache
def case_of(name: str, scene: str = "scene", model: str = "glossy") -> Case:
    """A system, its materials and its mesh, built once."""
    return Case(*SYSTEMS[name].make(scene, model), mesh(scene))


def light(seed: int = 0, *, lamps: int = 2) -> Environment:
    """Soft light with some brighter texels."""
    random = np.random.default_rng(seed)
    radiance = random.uniform(0.2, 1.0, (6, SIZE, SIZE, 3))
    radiance.reshape(-1, 3)[random.permutation(6 * SIZE**2)[:lamps]] += 5.0
    return Environment(jnp.asarray(radiance, jnp.float32))


def color_of(case: Case, environment: Environment, points: Any = VERTICES) -> np.ndarray:
    """Radiance of all vertices, or of points."""
    return np.asarray(prt.radiance(case.system, environment, eye=EYE, materials=case.materials, points=points))


@jax.jit
def relit(system: prt.System, environment: Environment, materials: Any, points: Any = VERTICES) -> jax.Array:
    """Radiance of all vertices, or of points, by one program."""
    return prt.radiance(system, environment, eye=EYE, materials=materials, points=points)


# How far pages are off systems at full resolution: lobes have diffuse light of degree 6, dynamic parts lose the tensor.
EXPORTED = {"harmonic": 1e-5, "harmonic, diffuse": 1e-5, "dynamic": 0.15}
EXPORTED |= dict.fromkeys(["lobe", "lobe, matte", "lobe, bright texels"], 0.005)


@each_system
def test_a_page_shows_a_system_or_refuses_it_by_name(name, close):
    case = case_of(name)
    if name not in EXPORTED:
        with pytest.raises(ValueError, match=r"the ball must have a system with the method `exported` .*, got \w+$"):
            case.system.exported("the ball")
        return
    shown = Case(case.system.exported("the ball").relit(), case.materials, case.mesh)
    environment = light(lamps=0)
    close(color_of(shown, environment), color_of(case, environment), tolerance=EXPORTED[name])


@each_system
def test_a_white_surface_in_a_white_furnace_is_white(name):
    if SYSTEMS[name].white is None:
        pytest.skip("direct light alone fills a furnace")
    case = case_of(name, "ball", "white")
    facing = np.sum(np.asarray(case.mesh.normal) * (np.asarray(EYE) - np.asarray(case.mesh.position)), 1) > 0.3
    color = color_of(case, Environment(jnp.ones((6, SIZE, SIZE, 3))))[facing]
    np.testing.assert_allclose(np.sqrt(np.mean((color - 1) ** 2)), 0, atol=SYSTEMS[name].white)


@each_system
def test_radiance_is_that_of_the_exact_sum_vertex_by_vertex(name, close):
    if SYSTEMS[name].error is None:
        pytest.skip("matte, or with reflected light")
    case, environment = case_of(name), light()
    exact = prt.reference.integrate(
        jnp.asarray(seen("scene").seen(np.arange(case.system.vertices))),
        seen("scene").position,
        seen("scene").frame,
        GLOSSY,
        environment,
        EYE,
    )
    facing = np.sum(np.asarray(case.mesh.normal) * (np.asarray(EYE) - np.asarray(case.mesh.position)), 1) > 0.2
    close(color_of(case, environment)[facing], np.asarray(exact)[facing], tolerance=SYSTEMS[name].error)


@each_system
def test_radiance_is_linear_in_the_light_and_zero_without(name, close):
    case, first, second = case_of(name), light(1), light(2)
    once = color_of(case, first)
    assert not color_of(case, Environment(jnp.zeros((6, SIZE, SIZE, 3)))).any()
    for strength in (3.0, 1e-25, 1e25):
        scaled = Environment(np.asarray(first.radiance) * np.float32(strength))
        close(color_of(case, scaled) / strength, once, tolerance=1e-5)
    if SYSTEMS[name].linear:
        both = color_of(case, Environment(np.asarray(first.radiance) + np.asarray(second.radiance)))
        close(both, once + color_of(case, second), tolerance=1e-5)


@each_system
def test_each_channel_of_the_light_reaches_only_itself(name, close):
    case, whole = case_of(name), color_of(case_of(name), light())
    for channel in (0, 2):
        color = color_of(case, Environment(jnp.asarray(np.asarray(light().radiance) * (np.arange(3) == channel))))
        assert not np.delete(color, channel, axis=1).any()
        if SYSTEMS[name].linear:
            close(color[:, channel], whole[:, channel])


@each_system
def test_eyes_below_the_horizon_see_what_grazing_eyes_see(name, close):
    case, of = case_of(name), case_of(name).mesh
    for vertex in (12, 31, 80):
        beside = np.asarray(of.position)[vertex] + np.asarray(of.tangent)[vertex]
        eyes = [jnp.asarray(beside + height * np.asarray(of.normal)[vertex]) for height in (-3, 0.005)]
        color = [np.asarray(prt.radiance(case.system, light(), eye=eye, materials=case.materials)) for eye in eyes]
        close(color[0][vertex], color[1][vertex])


@each_system
@pytest.mark.filterwarnings("ignore:a camera at .* sees 100% of part")
def test_vertices_that_see_nothing_are_black(name):
    if "bounces" in name:
        pytest.skip("tests/systems/bounces have a closed room")
    assert not color_of(case_of(name, "inside"), light()).any()


@each_system
def test_eyes_in_odd_places_give_finite_radiance_and_gradients(name):
    case = case_of(name)
    place = np.asarray(case.mesh.position)[7]
    beside = place * (1 + 1e-6)
    for eye in (place, beside, [0, 0, 0], [1e15, 1e15, -1e15], [50, -1.01, 3], [50, -1.01 + 1e-30, 3], [50, -7, 3]):
        color, *slope = weighted(case, light(), np.asarray(eye, np.float32), np.ones(1))
        assert np.isfinite(color)
        assert all(np.isfinite(part).all() for part in slope)


@jax.jit
def differentiated(system, radiance, eye, materials, weight):
    """Radiance, and the gradients of its weighted sum in the light and in the eye: one program for all that follows."""

    def total(radiance, eye):
        color = prt.radiance(system, Environment(radiance), eye=eye, materials=materials)
        return jnp.sum(weight * color), color

    (_, color), slope = jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(radiance, eye)
    return color, *slope


def weighted(case: Case, environment: Environment, eye: Any, weight: np.ndarray) -> tuple[float, np.ndarray, ...]:
    """The weighted sum of the radiance, in float64, and its gradients in the light and in the eye."""
    weight = np.broadcast_to(weight, (case.system.vertices, 3)).astype(np.float32)
    color, *slope = differentiated(case.system, environment.radiance, eye, case.materials, weight)
    return np.vdot(weight.astype(float), color), *(np.asarray(part, float) for part in slope)


def random_weight(case: Case) -> np.ndarray:
    """Weights of either sign of vertices and colors."""
    return np.random.default_rng(5).normal(size=(case.system.vertices, 3)).astype(np.float32)


@each_system
def test_stages_give_the_whole_inside_a_program_and_outside(name, close):
    case = case_of(name)
    system, materials, _ = case
    whole = color_of(case, light())
    arriving = system.shade(system.light(light()), materials)
    close(system.combine(arriving, system.view(EYE, materials)), whole)
    compiled, *_ = differentiated(system, light().radiance, EYE, materials, random_weight(case))
    close(compiled, whole, tolerance=2e-5)


@each_system
def test_products_in_the_verbs_and_in_their_gradients_are_exact_on_gpus(name, loose):
    case = case_of(name)
    assert not loose(differentiated, case.system, light().radiance, EYE, case.materials, random_weight(case))


@each_system
def test_a_batch_of_lights_is_each_light_by_itself(name, close):
    case = case_of(name)
    batch = Environment(jnp.asarray(np.stack([light(seed).radiance for seed in (3, 4)])[None]))
    color = np.asarray(relit(case.system, batch, case.materials))
    assert color.shape == (1, 2, case.system.vertices, 3)
    close(color[0, 1], color_of(case, light(4)), tolerance=2e-5)


def some_materials(case: Case, seed: int) -> Any:
    """Random materials of all vertices; none of scenes, whose parts have fixed BRDFs here."""
    if isinstance(case.system, prt.RelitScene):
        return None
    weight = np.random.default_rng(seed).uniform(size=(case.system.vertices, 1, 3))
    return prt.Blend(weight.astype(np.float32))


@jax.jit
def batched(system: prt.System, radiance: jax.Array, eyes: jax.Array, materials: Any) -> tuple[jax.Array, ...]:
    """Radiance by `jax.vmap` over lights, over eyes and over materials, and gradients by a batch of lights."""

    def one(radiance, eye, materials):
        return prt.radiance(system, Environment(radiance), eye=eye, materials=materials)

    arguments = [(radiance, EYE, None), (radiance[0], eyes, None), (radiance[0], EYE, materials)]
    axes = [(0, None, None), (None, 0, None), (None, None, 0)]
    pairs = list(zip(axes, arguments, strict=True))[: 2 if materials is None else 3]
    slope = jax.grad(lambda lights: jnp.sum(one(lights, EYE, None) ** 2))(radiance)  # a batch of lights
    return *(jax.vmap(one, axis)(*argument) for axis, argument in pairs), slope


@each_system
def test_vmap_over_lights_eyes_and_materials_is_a_loop(name, close):
    case, lights, eyes = case_of(name), [light(3), light(4)], np.stack([EYE, [-2.0, 1.5, 1.0]]).astype(np.float32)
    materials = [some_materials(case, seed) for seed in (0, 1)]
    stacked = jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows)), *materials)
    radiance = jnp.asarray(np.stack([environment.radiance for environment in lights]))
    of_lights, of_eyes, *of_materials, slope = batched(case.system, radiance, jnp.asarray(eyes), stacked)
    for number in (0, 1):
        close(of_lights[number], relit(case.system, lights[number], None), tolerance=2e-5)
        close(of_eyes[number], prt.radiance(case.system, lights[0], eye=eyes[number]), tolerance=2e-5)
        for color in of_materials:
            close(color[number], relit(case.system, lights[0], materials[number]), tolerance=2e-5)
        weight = 2 * np.asarray(of_lights[number])
        close(slope[number], differentiated(case.system, radiance[number], EYE, None, weight)[1], tolerance=1e-4)


@each_system
def test_gradients_in_the_light_are_the_radiance_of_its_change(name, close):
    if not SYSTEMS[name].linear:
        pytest.skip("which texels are bright is chosen; gradients in the turn of the light are for all systems")
    case, weight, change = case_of(name), random_weight(case_of(name)), light(7)
    _, slope, _ = weighted(case, light(6), EYE, weight)
    close(np.vdot(slope, change.radiance), np.vdot(weight, color_of(case, change)), tolerance=1e-4)


# Largest deviation of central differences from gradients for each step, over three directions together. Tables of eight
# views and lights of eight texels bend within the longest one.
SLOPE = {0.1: 0.06, 0.03: 0.03, 0.01: 0.03, 0.003: 0.03}
OBLIQUE = np.array([1.537, 2.071, 2.483], np.float32)  # from EYE, lobes of some vertices point between texels


def soft(angle: float) -> tuple[Environment, np.ndarray]:
    """Light of few, wide lamps that is turned about the vertical axis, and its derivative by the angle."""
    x, y, z = np.moveaxis(np.asarray(cubemap.direction(size=SIZE), float), -1, 0)
    cosine, sine = np.cos(angle), np.sin(angle)
    x, z = cosine * x + sine * z, cosine * z - sine * x
    radiance = np.stack([1 + 0.5 * x + 0.3 * y * z, 1.2 + 0.4 * z * x, 1 + 0.5 * y + 0.3 * x], -1)
    slope = np.stack([0.5 * z - 0.3 * y * x, 0.4 * (z * z - x * x), 0.3 * z], -1)  # x' = z, z' = -x
    return Environment(jax.device_put(radiance.astype(np.float32))), slope


def hold_to_differences(value: Callable, slopes: list[float], directions: list, start: Any) -> None:
    """Slopes of a smooth function along directions are its central differences over long and short steps."""
    for step, most in SLOPE.items():
        ends = [[value(start + sign * step * direction) for sign in (1, -1)] for direction in directions]
        numeric = np.array([(high - low) / (2 * step) for high, low in ends])
        rounding = 4 * np.finfo(np.float32).eps * abs(value(start)) / step
        assert np.linalg.norm(numeric - slopes) <= most * np.linalg.norm(slopes) + rounding, (step, numeric, slopes)


@each_system
def test_gradients_in_the_eye_are_differences_over_long_and_short_steps(name):
    case, (environment, _) = case_of(name), soft(0.3)
    to = OBLIQUE - np.asarray(case.mesh.position)
    facing = np.sum(np.asarray(case.mesh.normal) * to, 1) > 0.3 * np.linalg.norm(to, axis=1)
    weight = facing[:, None] / facing.sum()
    directions = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0].astype(np.float32)
    slope = weighted(case, environment, OBLIQUE, weight)[2]
    hold_to_differences(
        lambda eye: weighted(case, environment, eye, weight)[0], directions @ slope, directions, OBLIQUE
    )
    assert np.isfinite(weighted(case, environment, EYE, weight)[2]).all()


@each_system
def test_gradients_in_the_turn_of_the_light_are_differences_over_long_and_short_steps(name):
    case, (environment, turn) = case_of(name), soft(0.3)
    # Of one side alone: all around, the radiance of a turned light hardly changes, and rounding would be measured.
    weight = np.maximum(np.asarray(case.mesh.normal) @ [0.8, 0.0, 0.6], 0)[:, None] / (3 * case.system.vertices)
    slope = np.vdot(weighted(case, environment, EYE, weight)[1], turn)
    hold_to_differences(lambda angle: weighted(case, soft(angle)[0], EYE, weight)[0], [slope], [1.0], 0.3)


@each_system
def test_a_saved_system_relights_bit_for_bit(name, tmp_path):
    case = case_of(name)
    if name.endswith("bright texels"):
        assert isinstance(case.system.brdf, CookTorrance)
    prt.files.save(tmp_path / "system", case.system)
    loaded = prt.files.load(tmp_path / "system")
    np.testing.assert_array_equal(color_of(case._replace(system=loaded), light()), color_of(case, light()))


@each_system
def test_memory_counts_every_array_once(name):
    system = case_of(name).system
    arrays = {id(leaf): leaf.nbytes for leaf in jax.tree.leaves(system)}
    assert prt.memory(system) == sum(arrays.values()) > 0


@pytest.mark.long
@pytest.mark.parametrize("count", [32_769, 40_000])
@each_system
def test_sizes_at_which_a_compiler_was_wrong_agree_with_float64(name, count):
    # jaxlib 0.10.2 summed wrongly at these numbers of rows, with the optimization that users get.
    system, materials, _ = case_of(name, str(count))
    assert system.vertices == count
    single = relit(system, light(), materials)
    assert single.dtype == jnp.float32
    wrong = np.ones(count, bool)
    for shift in (0.0, 1e-5, -1e-5):  # Which texel a vertex looks up may hang on rounding: it then does in float64 too.
        if wrong.any():
            with jax.enable_x64(True):
                eye, *double = jax.tree.map(exact, (EYE + shift, system, light(), materials))
                expected = np.asarray(
                    jax.jit(lambda s, e, m, eye: prt.radiance(s, e, eye=eye, materials=m))(*double, eye)
                )
            assert expected.dtype == np.float64
            wrong &= np.abs(single - expected).max(1) >= 1e-4 * np.abs(expected).max()
    assert not wrong.any()


def exact(value: Any) -> Any:
    """An array of floating point in float64; other leaves unchanged."""
    floating = isinstance(value, jax.Array | np.ndarray) and jnp.issubdtype(value.dtype, jnp.floating)
    return value.astype(jnp.float64) if floating else value


def devices(count: int) -> list[jax.Device]:
    """Some devices; XLA_FLAGS asks for four."""
    if len(jax.devices()) < count:
        pytest.skip(f"XLA_FLAGS asks for {count} devices")
    return jax.devices()[:count]


@each_system
def test_a_triangle_laid_over_devices_is_lit_and_has_the_same_radiance(name, close):
    case = case_of(name, "triangle")
    system = prt.shard(case.system, devices(4))  # Three vertices, and a spare one where the system's arrays allow that.
    assert system.vertices == 3
    color = relit(system, light(), case.materials)
    assert len(color.sharding.device_set) == 4
    assert np.asarray(color).any()
    close(color, relit(case.system, light(), case.materials), tolerance=2e-5)


@pytest.mark.parametrize("name", LOOPS)
def test_a_system_laid_over_devices_has_the_same_gradients(name):
    case = case_of(name, "triangle")
    weight = random_weight(case)
    laid = prt.shard(case.system, devices(4))
    color, slope, _ = differentiated(laid, light().radiance, EYE, case.materials, weight)
    atol = 1e-4 * np.abs(weight * color).sum()
    np.testing.assert_allclose(np.vdot(slope, light().radiance), np.vdot(weight, color), atol=atol)


@pytest.mark.parametrize("name", ["separable", "lobe, bright texels"])
def test_each_device_has_an_equal_share_of_the_vertices(name, close):
    case = case_of(name, "triangle")
    even, spare = prt.shard(case.system, devices(3)), prt.shard(case.system, devices(4))
    close(relit(even, light(), case.materials), relit(case.system, light(), case.materials), tolerance=2e-5)
    assert type(even) is type(case.system)
    for laid, count in ((even, 3), (spare.system, 4)):
        transport = laid.transport if name == "separable" else laid.visibility
        assert len(transport.position) == count
        array = transport.value if name == "separable" else transport.pyramid
        shares = {shard.device: shard.data.shape for shard in array.addressable_shards}
        assert len(shares) == count
        assert len(set(shares.values())) == 1
        assert sum(map(np.prod, shares.values())) == array.size
    assert prt.memory(even) == prt.memory(case.system)
    points = Points(jnp.array([[0, 1], [1, 2], [2, 0]]), jnp.full((3, 2), 1 / 3))
    there = [relit(system, light(), case.materials, points) for system in (case.system, spare)]
    close(there[1], there[0], tolerance=2e-5)
    with pytest.raises(ValueError, match="corners of points must be between 0 and 2"):
        spare.view(EYE, None, Points(jnp.full((3, 1), 3), jnp.full((3, 1), 1 / 3)))


def test_materials_are_those_of_the_vertices_without_the_spare_ones(close):
    system, _ = lobes("scene", "channels")
    blend = random_blend(system)
    spare = prt.shard(system, devices(4))
    close(relit(spare, light(), blend), prt.radiance(system, light(), eye=EYE, materials=blend), tolerance=2e-5)
    with pytest.raises(ValueError, match=r"must have weights \[101 vertices, 3 channels, c\], got \[104, 3, 3\]"):
        spare.view(EYE, prt.Blend(jnp.ones((104, 3, 3))))


def test_a_transport_is_laid_over_devices_where_its_vertices_divide():
    transport = case_of("separable", "triangle").system.transport
    laid = prt.shard(transport, devices(3))
    coefficient = jnp.asarray(np.random.default_rng(3).normal(size=(6 * SIZE**2, 3)), jnp.float32)
    np.testing.assert_allclose(laid.apply(coefficient), transport.apply(coefficient), rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match="must be divisible by the 4 devices, got 3"):
        prt.shard(transport, devices(4))


@pytest.mark.usefixtures("unchecked")
def test_what_are_no_devices_and_what_has_no_vertices_are_refused():
    system, here = case_of("lobe", "triangle").system, jax.devices()[0]
    for wrong in ([], "cuda", ["cuda:0"], [here, here], 4, None):
        with pytest.raises(ValueError, match=r"devices must be one or more of \["):
            prt.shard(system, wrong)
    with pytest.raises(TypeError, match="have vertices, got Environment"):
        prt.shard(light(), [here])


def points_of(case: Case, triangle: np.ndarray, weight: np.ndarray) -> tuple[Any, np.ndarray]:
    """Points of some triangles, and their order: scenes take one list for each part."""
    face, region = np.asarray(case.mesh.face)[triangle], np.asarray(case.mesh.region)
    if not isinstance(case.system, prt.RelitScene):
        return on_triangles(case.mesh.face, triangle, weight), np.arange(len(triangle))
    lists, order = [], []
    for number in range(region.max() + 1):
        inside = np.flatnonzero(region[face[:, 0]] == number)
        place = np.cumsum(region == number) - 1
        lists.append(Points(jnp.asarray(place[face[inside]].T), jnp.asarray(weight[inside].T)))
        order.append(inside)
    return lists, np.concatenate(order)


@each_system
def test_radiance_at_the_corners_of_triangles_is_that_of_the_vertices(name, close):
    case = case_of(name)
    triangle = np.arange(len(case.mesh.face))
    for corner in (0, 2):
        weight = np.tile(np.eye(3, dtype=np.float32)[corner], (len(triangle), 1))
        points, order = points_of(case, triangle, weight)
        color = relit(case.system, light(), case.materials, points)
        assert len(color) == len(triangle)
        close(color, color_of(case, light())[np.asarray(case.mesh.face)[order, corner]], tolerance=2e-5)


def inside_triangles(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """A random point on each triangle, as its number and weights."""
    triangle = np.arange(len(case.mesh.face))
    return triangle, np.random.default_rng(0).dirichlet(np.ones(3), len(triangle)).astype(np.float32)


@each_system
def test_radiance_at_points_is_the_exact_sum_there(name, close):
    if SYSTEMS[name].error is None:
        pytest.skip("matte, or with reflected light")
    case = case_of(name)
    triangle, weight = inside_triangles(case)
    points = on_triangles(case.mesh.face, triangle, weight)
    visible = seen("scene")
    level = np.round(points.carry(jnp.asarray(visible.seen(np.arange(case.system.vertices)), jnp.float32)))
    position, frame = points.carry(visible.position), points.frame(visible.frame)
    exact = np.asarray(prt.reference.integrate(level.astype(np.uint8), position, frame, GLOSSY, light(), EYE))
    facing = np.sum(np.asarray(frame)[:, 2] * (np.asarray(EYE) - np.asarray(position)), 1) > 0.2
    lists, order = points_of(case, triangle, weight)
    color = np.asarray(relit(case.system, light(), case.materials, lists))
    facing, exact = facing[order], exact[order]
    # What arrives in the frames of three vertices is interpolated there: this mesh is coarse.
    close(color[facing], exact[facing], tolerance=SYSTEMS[name].error + 0.05)


@pytest.mark.parametrize("name", ["separable, clustered", "harmonic", "lobe, bright texels"])
def test_points_go_through_programs_and_batches_and_have_gradients(name, close):
    case = case_of(name)
    system, (points, _) = case.system, points_of(case, *inside_triangles(case))

    def seen(system, lit, eye):
        color = system.combine(lit, system.view(eye, case.materials, points), points)
        return jnp.sum(color), color

    lit, eyes = system.shade(system.light(light()), case.materials), np.stack([EYE, 2 * np.asarray(EYE)])
    batch = jax.jit(jax.vmap(jax.grad(seen, argnums=2, has_aux=True), (None, None, 0)))
    slope, color = batch(system, lit, eyes)
    assert np.isfinite(slope).all()
    close(color[0], color_of(case, light(), points), tolerance=2e-5)


@each_system
@pytest.mark.usefixtures("unchecked")
def test_what_are_no_points_are_refused(name):
    with pytest.raises(TypeError, match="points must be"):
        case_of(name).system.view(EYE, None, np.zeros(3))


OUTSIDE = [
    ([[99999], [1], [2]], [[1.0], [0.0], [0.0]], r"corners of points must be between 0 and \d+, got 1 of 3"),
    ([[0], [1], [2]], [[np.nan], [1.0], [0.0]], "weights of points must be finite"),
    ([[0], [1], [2]], [[2.0], [-1.0], [0.0]], "weights of points must be at least 0"),
    ([[0], [1], [2]], [[1.0], [1.0], [1.0]], "weights of points must sum to 1, got 3 at point 0"),
    ([[0], [1], [2]], [[1.0, 0.0, 0.0]], r"must have corners \[k, p\] and weights \[k, p\]"),
]


@each_system
@pytest.mark.usefixtures("unchecked")
def test_points_outside_of_triangles_are_refused(name):
    system = case_of(name).system
    for corner, weight, message in OUTSIDE:
        wrong = Points(jnp.asarray(corner), jnp.asarray(weight))
        with pytest.raises(ValueError, match=message):
            system.view(EYE, None, [wrong] * 2 if isinstance(system, prt.RelitScene) else wrong)


@each_system
@pytest.mark.usefixtures("unchecked")
def test_what_is_of_another_kind_is_refused_by_what_makes_it(name):
    system, materials, _ = case_of(name)
    with pytest.raises(TypeError, match=r"light must be .*Environment, which jaxprt.scene.load_environment makes"):
        prt.radiance(system, light().radiance, eye=EYE, materials=materials)
    with pytest.raises((TypeError, ValueError), match="eye must be"):
        system.view(np.zeros(2, np.float32), materials)
    with pytest.raises(TypeError, match="light must be"):
        system.combine(light(), system.view(EYE, materials))
    with pytest.raises(TypeError, match="materials must be"):
        system.view(EYE, 3)


@each_system
@pytest.mark.usefixtures("unchecked")
def test_lights_of_another_size_are_refused(name):
    if "harmonic" in name:
        pytest.skip("takes lights of any size that it can reduce")
    with pytest.raises(ValueError, match=r"light('s faces)? must .*\b8\b.* got .*\b16\b"):
        case_of(name).system.light(Environment(jnp.ones((6, 16, 16, 3))))


@pytest.mark.usefixtures("unchecked")
def test_only_systems_are_relit_and_those_of_equal_lights_say_so():
    first, second = case_of("lobe").system, case_of("lobe", "ball").system
    assert first.shared_light == second.shared_light is not None
    assert case_of("separable").system.shared_light is None
    assert case_of("lobe, bright texels").system.shared_light != first.shared_light
    assert protocol.System.shared_light.fget(first) is None
    with pytest.raises(TypeError, match=r"system must be one of jaxprt, such as .*, got SparseTransport"):
        prt.radiance(case_of("separable").system.transport, light(), eye=EYE)
    with pytest.raises(ValueError, match=r"the same number of vertices, got \[3, 101\]"):
        prt.total(case_of("lobe", "triangle").system, case_of("lobe").system)
    with pytest.raises(ValueError, match="at least one"):
        prt.radiance(case_of("lobe").system, Environment(jnp.ones((0, 6, SIZE, SIZE, 3))), eye=EYE)


def random_blend(system: prt.System) -> prt.Blend:
    """Weights of three channels and colors."""
    return prt.Blend(np.random.default_rng(0).uniform(size=(system.vertices, 3, 3)).astype(np.float32))


BLENDED = ["separable", "harmonic", "lobe", "lobe, bright texels"]


@pytest.mark.parametrize("name", BLENDED)
@pytest.mark.usefixtures("unchecked")
def test_a_blend_weights_the_channels_of_each_vertex(name, close):
    system, _ = SYSTEMS[name].make("scene", "channels")
    weight = np.asarray(random_blend(system).weight)
    mixed = prt.radiance(system, light(), eye=EYE, materials=prt.Blend(weight))
    channel = np.arange(3)[:, None]
    unit = [prt.Blend(np.broadcast_to(np.float32(channel == k), weight.shape)) for k in range(3)]
    one = [prt.radiance(system, light(), eye=EYE, materials=blend) for blend in unit]
    close(mixed, np.einsum("kvc,vkc->vc", np.stack(one), weight), tolerance=2e-5)
    with pytest.raises(ValueError, match=r"must have weights \[101 vertices, 3 channels, c\], got \[101, 2, 3\]"):
        system.view(EYE, prt.Blend(weight[:, :2]))


@pytest.mark.parametrize("name", ["harmonic", "lobe"])
def test_a_blend_chooses_the_parameter_of_each_vertex(name, close):
    knot = [np.log([0.4, 0.6])]

    def rough(m):
        return CookTorrance(diffuse=0.5, specular=0.5, roughness=jnp.exp(m), f0=0.4)

    transport = case_of(name).system.transport
    if name == "lobe":
        table = lobe.tabulate(rough, lobes=4, resolution=8, knot=knot)
        system, fixed = lobe.LobeSystem(transport, table), lobe.LobeSystem(transport, table.at(jnp.asarray(-0.7)))
    else:
        table = harmonic.tabulate(rough, degree=4, error=0.5, knot=knot)
        system, fixed = harmonic.HarmonicSystem(transport, table), None
    count = system.vertices
    ones = jnp.ones((count, 1, 1))
    value = np.where(np.arange(count) % 2, -0.7, np.log(0.6)).astype(np.float32)
    color, same = (
        prt.radiance(system, light(), eye=EYE, materials=prt.Blend(ones, (jnp.asarray(parameter),)))
        for parameter in (value, np.full(count, -0.7, np.float32))
    )
    close(np.asarray(color)[1::2], np.asarray(same)[1::2])
    assert np.abs(np.asarray(color)[::2] - np.asarray(same)[::2]).max() > 1e-3
    if fixed is not None:
        close(same, prt.radiance(fixed, light(), eye=EYE), tolerance=2e-5)
    for wrong in ((), (jnp.asarray(value), jnp.asarray(value))):
        with pytest.raises(ValueError, match="parameters"):
            system.view(EYE, prt.Blend(ones, wrong))
    with pytest.raises(ValueError, match="parameters of the blend must be finite"):
        prt.Blend(ones, (jnp.full(count, jnp.nan),))


HALF = ("float16", "bfloat16")


@each_system
@pytest.mark.usefixtures("unchecked")
def test_lights_and_eyes_of_every_float_type_give_one_radiance(name, close):
    system, materials, _ = case_of(name)
    radiance = partial(prt.radiance, system, materials=materials)
    bright = light().radiance
    exact = radiance(Environment(bright), eye=EYE)
    for dtype in ("bfloat16", "float64"):
        rounded = np.asarray(bright).astype(jnp.dtype(dtype))
        expected = radiance(Environment(jnp.asarray(rounded, jnp.float32)), eye=EYE)
        kind = jnp.dtype(dtype if dtype in HALF else "float64")
        color = radiance(Environment(rounded), eye=np.asarray(EYE).astype(kind))
        assert color.dtype == exact.dtype
        close(color, expected, tolerance=1e-5)  # EYE is exact in half precision
    with jax.numpy_dtype_promotion("strict"):
        close(radiance(Environment(bright), eye=np.asarray(EYE, np.float16)), exact, tolerance=1e-5)
    half = Environment(bright)
    object.__setattr__(half, "radiance", bright.astype(jnp.bfloat16))  # such as by `jax.tree.map`
    assert radiance(half, eye=list(map(float, EYE))).dtype == exact.dtype


@each_system
def test_gradients_come_back_in_the_type_of_the_light_and_the_eye(name):
    case = case_of(name)
    arguments = jax.ShapeDtypeStruct(light().radiance.shape, jnp.bfloat16), jax.ShapeDtypeStruct((3,), jnp.float16)
    _, *slope = jax.eval_shape(differentiated, case.system, *arguments, case.materials, random_weight(case))
    assert [part.dtype for part in slope] == [argument.dtype for argument in arguments]


@pytest.mark.usefixtures("x64")
def test_a_light_of_float32_is_taken_where_float64_is_enabled(close):
    random, frame = np.random.default_rng(0), jnp.tile(jnp.eye(3), (3, 1, 1))
    matrix = harmonic.TransferMatrix(jnp.asarray(random.normal(size=(3, 1, 9, 9))), jnp.zeros((3, 3)), frame)
    table = harmonic.HarmonicBrdf(jnp.asarray(random.normal(size=(9, 1, 4, 4))), (), jnp.zeros(()))
    system = harmonic.HarmonicSystem(matrix, table)
    bright = np.random.default_rng(0).uniform(0.2, 1.0, (6, 4, 4, 3)).astype(np.float32)
    colors = [
        prt.radiance(system, Environment(jnp.asarray(bright, dtype)), eye=jnp.asarray(EYE, dtype))
        for dtype in ("float32", "float64")
    ]
    assert colors[0].dtype == colors[1].dtype == np.float64
    close(*colors, tolerance=1e-5)


@each_system
@pytest.mark.usefixtures("unchecked")
def test_the_largest_and_smallest_lights_make_no_nan_and_larger_ones_are_refused(name):
    system, materials, _ = case_of(name)
    radiance = partial(prt.radiance, system, eye=EYE, materials=materials)
    for scale in (1e32 / 6.0, 1e-20, 1e-38):
        assert np.isfinite(radiance(Environment(np.asarray(light().radiance) * np.float32(scale)))).all()
    for wrong in (1e33, 1e38):
        with pytest.raises(ValueError, match=r"radiance must be at most 1e\+32 in magnitude, got 384 of 384"):
            Environment(np.full((6, SIZE, SIZE, 1), wrong, np.float32))


@pytest.mark.parametrize("name", BLENDED)
@pytest.mark.usefixtures("unchecked")
def test_lights_of_two_or_four_colors_are_refused_by_number_where_the_materials_have_three(name):
    system, _ = SYSTEMS[name].make("scene", "channels")
    view = system.view(EYE, random_blend(system))
    for colors in (2, 4):
        lit = system.shade(system.light(Environment(jnp.ones((6, SIZE, SIZE, colors)))))
        with pytest.raises(ValueError, match=rf"colors.* got .*\b{colors}\b"):
            system.combine(lit, view)


# The last test here: it forgets all programs, twice.
@pytest.mark.parametrize("name", LOOPS)
def test_what_gpus_run_gives_the_same_radiance(name, request, close):
    case = case_of(name, "triangle")
    expected = np.asarray(relit(case.system, light(), case.materials))
    request.getfixturevalue("elsewhere")
    close(relit(case.system, light(), case.materials), expected, tolerance=2e-5)
    text = relit.trace(case.system, light(), case.materials).lower(lowering_platforms=("cuda",)).as_text()
    assert "complex<" not in text
