"""What every public pure function of the package promises, checked for all of them from one table of examples.

Public functions are found by walking the package; one without an example fails. To add one, add a line to EXAMPLES:

    "room.module.function": example(lambda draw: call(draw.unit(5), draw.normal(4)), keep=3),

* ``call(...)`` holds the arrays (and pytrees of arrays), as the function takes them, by position or by name.
  ``draw`` makes small random ones in the dtype under test; see ``Draw``.
* Further keywords are static options.
* ``gradient=("light", "eye")`` names the arguments in which the function is differentiable where these are not all
  that hold floating-point arrays; ``gradient=()`` says none. ``batch=False`` says that ``jax.vmap`` is not promised.
  A comment gives the reason.

Public classes that can be called, as BRDF models can, have examples too: the first argument is the instance.
Functions that are not pure, or run on the host, are named in REASONS.
"""

import functools
import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt
from benchmarks import published
from benchmarks.published.lobes import BrdfSet, Remainder
from benchmarks.published.quantized import quantize
from jaxprt import brdf, dynamic, scene, visibility
from jaxprt import harmonic as harmonic_system
from jaxprt import lobe as lobe_system
from jaxprt import separable as separable_system
from jaxprt.brdf.varying import Channels, PerVertex
from jaxprt.decompose import mixture as mixture_system
from jaxprt.image import Pixels, raster
from jaxprt.scene.environment import Sun
from jaxprt.scene.points import Points
from jaxprt.systems.lamps import LampTransport

GRADIENT_TOLERANCE = 1e-5  # Central differences in float64, of the norm of the gradient.
STEP = 1e-6
BATCH = 3
JITTED = type(jax.jit(lambda: 0))

# By reason: public functions, and modules of them, that the rules below do not hold for.
REASONS = {
    "checks values, or chooses by them": """
        require scene.points.on_triangles benchmarks.published.factorization benchmarks.published.lobes.mirror_lobes
        require.finite require.length systems.light_cells.counts systems.harmonic.transfer.check
        systems.harmonic.transfer.check_memory
        brdf.measured.require brdf.measured.check_unique brdf.measured.one_of brdf.models.color brdf.models.scalar
        systems.harmonic.table.tabulate systems.separable.factorization.check_mark
        systems.separable.factorization.factor systems.lobe.table.tabulate systems.lobe.table.brdf_samples
        systems.lobe.table.is_isotropic systems.dynamic.reflected.reflect systems.dynamic.reflected.check_values
        systems.bounces.functions.shared brdf.places.in_columns brdf.navigation.blinn_phong
        systems.dynamic.table.tabulate systems.separable.factorization.tabulate image.arguments
        scene.camera.in_common_coordinates scene.environment.environment_from_image scene.light_probes.irradiance
    """,
    "takes functions": "compile brdf.microfacet.values",
    "reads or writes files, or runs workers": """
        programs cli daylight brdf.fitted view files visibility.blocks systems.separable.clustered.precompute
        systems.harmonic.exchange brdf.scattered brdf.measured.load_merl brdf.measured.load_npf
        brdf.navigation.cook_torrance systems.dynamic.transport.compress scene.mesh scene.formats
        scene.environment.load_environment scene.environment.layout_of
    """,
    "NumPy, or values or types that are looked at, on the host": """
        inverse scene.texture.unit_normals scene.sides image.pixels.sky image.pixels.pixel_angle systems.axes
        systems.ranges systems.lobe.system.matte_transport systems.lobe.pyramid.compress systems.lobe.pyramid.dither
        systems.lamps.places systems.lamps.outline.of_lamps systems.lamps.outline.triangles
        systems.bounces.traced.is_sharp systems.bounces.traced.is_traced visibility.members.cluster
        visibility.members.coordinates systems.bright_texels.samples_for decompose.clustering
        decompose.eigen.orientation decompose.tucker.orient systems.separable.factorization.mark_of
        systems.dynamic.reflected.stacked systems.bounces.gather.shares systems.bounces.gather.cosines
        systems.bounces.gather.measures systems.bounces.patches.divide brdf.places.columns scene.origin
        scene.scene.along_texture
        scene.camera.localize scene.scene.centered scene.scene.default_camera scene.material.opacity_of_parts
        scene.texture.dpdu scene.texture.handedness scene.occluder scene.subdivision scene.light_samples scene.builtin
        benchmarks.published.interiors scene.camera.orbit scene.environment.resample scene.panorama scene.panorama_loops
        scene.environment.finer scene.environment.add_disk scene.environment.disk_share scene.environment.resized
        systems.harmonic.exported systems.lobe.exported scene.environment.sky
    """,
    "traces rays": """
        sensors
        relit visibility.picture_rays image.pixels.visible_points image.pixels.coverage image.pixels.nearest_fragments
        visibility.rays visibility.occluder visibility.embree visibility.picture_loops visibility.refinement
        systems.separable.sparse.precompute benchmarks.published.interreflection visibility.stored.precompute
        systems.lobe.pyramid.precompute systems.lamps.transport systems.harmonic.transfer.precompute
        systems.harmonic.transfer.precompute_diffuse systems.reference.radiance systems.bounces.gather.rays
        systems.bounces.build.precompute systems.bounces.patches.exchange systems.bounces.jobs
        systems.dynamic.transport.precompute visibility.starts
    """,
    "takes parts; what they look like at points is in tests/scene/test_material_table.py": "scene.material_table",
    "gives numbers or names, or as many results as the size says": """
        scene.texture.mipmap systems.lobe.blurred_light.blur sphere.hats.count systems.lobe.diffuse.cells
        systems.lobe.diffuse.count visibility.members.clusters_for systems.separable.sparse.rms
        systems.lobe.table.measured_error systems.bounces.tensor.twice systems.dynamic.transport.clustering
        scene.scene.unique_names sphere.harmonics.degree_of sphere.haar.face_edge
    """,
    "gives numbers of texels": "scene.texture.bilinear",
    "takes numbers of triangles; tests/image/test_pixels.py": "image.raster.barycentric",
    "clamps; tests/scene/test_texture.py has SciPy's answers": """
        scene.texture.tilt_normals scene.texture.normal_variance scene.texture.widen_roughness
    """,
    "a NumPy table, or an index in one": """
        sphere.patches sphere.hats.centers sphere.hats.table sphere.hats.inverse_gram systems.lobe.pyramid.scales
        systems.lobe.pyramid.between systems.lobe.pyramid.corners systems.lobe.blurred_light.scales
        systems.lobe.blurred_light.finer_scales systems.lobe.pyramid.of_scale
        visibility.members.places sphere.cubemap.axes brdf.measured.cell_angles brdf.measured.lower_cosine
        brdf.measured.tabulate sphere.cubemap.border_index sphere.harmonics.quadrature
    """,
    "gives truth values": """
        image.raster.front image.raster.front_faces image.pixels.seen_from_front brdf.models.both_above
    """,
    "by NumPy or JAX, as the last argument says; image.tonemap.display is the function": "image.tonemap.apply_curve",
    "has more padding in jit than outside; tests/image/test_pixels.py": "image.pixels.shading_points",
    "takes an index": "benchmarks.published.lobes.SetMember",
    "takes half precision; tests/figures/test_transfer.py": "benchmarks.published.transfer",
    "gives vectors of either sign": """
        benchmarks.published.tensors.hooi decompose.tucker.hosvd decompose.tucker.truncated decompose.tucker.dominant
    """,
    "takes or gives bytes or half precision": """
        systems.lobe.diffuse.vectors systems.lobe.diffuse.harmonics_of systems.lobe.pyramid.bits
        systems.lobe.pyramid.pyramid systems.separable.clustered.compress systems.lobe.pyramid.from_bits
        systems.lobe.pyramid.texel_bits
    """,
    "takes indices, frames and shares; bright_texels.radiance has them all": "systems.bright_texels.texel_radiance",
    "takes unit normals; tests/systems/lobe/test_diffuse.py": "systems.lobe.diffuse.flux",
    "takes points; tests/systems/lobe/test_diffuse.py": "systems.lobe.diffuse.at_points",
    "gives indices beside weights, compiled in steps; combine has them all": "systems.lobe.system.view_lobes",
    "views and sums of systems; tests/systems/lobe/test_widened.py": "systems.lobe.widened",
    "a step of ReflectingPart; tests/systems/bounces/test_traced.py": """
        systems.bounces.traced.lookup systems.bounces.traced.harmonics_of systems.bounces.traced.quantiles
        systems.bounces.traced.weights systems.bounces.traced.very_narrow
    """,
    "reads files, on the host; the rest fits what is in them": "systems.standard",
    "integrates cells that a loop chooses; reference.integrate has them all": "systems.adaptive",
    "one formula for NumPy and JAX arrays": "brdf.coat.coat_reflectance",
    "tested through the models": "brdf.models.half_vector",
    "gives indices beside weights; tested through the tables that are read by it": "brdf.grid",
    "counts colors by values": "systems.bounces.functions.basis systems.bounces.functions.fixed_weights",
    "gives its argument; tested through the places": "brdf.places.identity",
    "by SciPy, where data enters": "brdf.places.triangulate",
    "empty arrays": "systems.dynamic.table.without_tensor",
    "puts arrays on devices": "systems.devices",
    "calls the methods of systems; tests/systems/test_protocol.py holds these": "systems.protocol",
    "takes half precision; tests/systems/test_protocol.py has scenes": "systems.bounces.tensor.light_side",
    "takes half precision; the same": "systems.bounces.tensor.collect",
    "the steps of lobe.tabulate, and tested through it": "systems.lobe.em",
    "draws its own directions": "systems.separable.factorization.light_errors",
    "calls the reference implementation": "image.metrics.flip",
    "by NumPy or JAX, as its first argument says; evaluate is the function": "sphere.harmonics.basis",
}
HOST = {name: reason for reason, names in REASONS.items() for name in names.split()}


class Draw:
    """Random arguments in the default dtype, the same for the same seed; made by NumPy, which compiles nothing."""

    def __init__(self, seed: int):
        self.random = np.random.default_rng(seed)

    def array(self, value):
        """A jax array in the default dtype."""
        return jax.device_put(np.asarray(value, jnp.result_type(float)))

    def normal(self, *shape):
        """Random values of either sign, of the order of 1."""
        return self.array(self.random.normal(size=shape))

    def uniform(self, *shape, low=0.1, high=0.9):
        """Between two positive bounds."""
        return self.array(self.random.uniform(low, high, size=shape))

    def integer(self, high, *shape, dtype=jnp.int32):
        """From 0 to high - 1."""
        return jax.device_put(np.asarray(self.random.integers(high, size=shape), dtype))

    def unit(self, *shape):
        """Unit vectors all around."""
        vector = self.random.normal(size=(*shape, 3))
        return self.array(vector / np.linalg.norm(vector, axis=-1, keepdims=True))

    def upper(self, *shape):
        """Unit vectors well above the horizon of their local frame."""
        vector = np.array(self.unit(*shape), float)
        vector[..., 2] = np.abs(vector[..., 2]) + 0.3
        return self.array(vector / np.linalg.norm(vector, axis=-1, keepdims=True))

    def rotation(self, *shape):
        """Proper rotations."""
        matrix, _ = np.linalg.qr(self.random.normal(size=(*shape, 3, 3)))
        return self.array(matrix * np.sign(np.linalg.det(matrix))[..., None, None])

    def symmetric(self, size):
        """A matrix whose eigenvalues of both signs lie well apart."""
        vector, _ = np.linalg.qr(self.random.normal(size=(size, size)))
        value = 3.0 ** -np.arange(size) * (-1.0) ** np.arange(size)
        return self.array((vector * value) @ vector.T)

    def mesh(self):
        """Two triangles; the one at the back fills the picture of ``camera``."""
        position = [[-9, -9, 0], [9, -8, 0], [1, 9, 0], [-0.6, -0.8, 0.5], [1, -0.6, 0.6], [0.2, 0.7, 0.4]]
        position = self.array(position + 0.05 * np.asarray(self.uniform(6, 3)))
        normal, tangent = (self.array(np.asarray(self.rotation(6))[:, axis]) for axis in (2, 0))
        face, region = np.array([[0, 1, 2], [3, 4, 5]], np.int32), np.zeros(6, np.int32)
        return scene.Mesh(position, jax.device_put(face), normal, tangent, jax.device_put(region))

    def camera(self):
        """Looks at ``mesh`` with a few pixels."""
        eye, target = self.uniform(3, low=0.01, high=0.09), self.uniform(3, low=0.01, high=0.09)
        eye = self.array(np.asarray(eye) + [0.2, 0.1, 4.0])
        return scene.Camera(eye, target, self.array([0.0, 1, 0]), self.uniform(low=0.6, high=0.7), 6, 5)

    def fragments(self, height=5, width=6):
        """What each pixel sees of ``mesh``."""
        weight, depth = np.asarray(self.uniform(height, width, 3)), self.uniform(height, width)
        weight = self.array(weight / weight.sum(-1, keepdims=True))
        return raster.Fragments(self.integer(2, height, width), weight, depth)

    def pixels(self, height=5, width=6):
        """Points of ``mesh``, two in each pixel but the last two, which show more of the background."""
        count = 2 * height * width
        weight, slope = np.asarray(self.uniform(count, 3)), self.normal(count, 2, 3)
        weight = self.array(weight / weight.sum(-1, keepdims=True))
        coverage = self.array(np.where(np.arange(count) < count - 4, 0.25, 0))
        background = self.array(np.where(np.arange(count // 2) < count // 2 - 2, 0.5, 1).reshape(height, width))
        triangle = jnp.where(coverage > 0, self.integer(2, count), -1)
        pixel = jax.device_put(np.minimum(np.arange(count, dtype=np.int32) // 2, count // 2 - 1))
        return Pixels(triangle, weight, slope, pixel, coverage, background)

    def light(self, size=4):
        """An environment."""
        return scene.Environment(self.uniform(6, size, size, 3))

    def separable(self, terms=2, size=4):
        """A factored BRDF."""
        maps = self.normal(terms, size, size, 1), self.normal(terms, size, size, 3)
        return separable_system.SeparableBrdf(*maps, self.uniform())

    def sparse(self, size=4, *, kept=5, vertices=3, terms=2):
        """Transport for ``light`` and ``separable``."""
        index = self.integer(6 * size * size, kept, vertices, terms, dtype=jnp.uint16)
        value = self.normal(kept, vertices, terms, 1)
        position, frame = self.normal(vertices, 3), self.rotation(vertices)
        return separable_system.SparseTransport(index, value, position, frame, self.uniform(6 * size * size))

    def direct(self, size=4, *, vertices=3):
        """Visibility for ``light``, in bytes for two vertices each."""
        level = self.integer(256, 1, 6 * size * size, visibility.rays.BLOCK // 2, dtype=jnp.uint8)
        return visibility.StoredVisibility(level, self.normal(vertices, 3), self.rotation(vertices))

    def pyramid(self, size=8, *, vertices=3):
        """Visibility at all scales, for ``light`` of the same size."""
        pyramid = self.integer(256, vertices, lobe_system.pyramid.scales(size).total, dtype=jnp.uint8)
        vector = self.integer(256, lobe_system.diffuse.count(size), vertices, dtype=jnp.uint8)
        return lobe_system.LobeTransport(pyramid, vector, self.normal(vertices, 3), self.rotation(vertices), size)

    def lobes(self, lobes=2):
        """Wide lobes at five nodes of the view angle, all above the horizon."""
        mean = self.array(np.moveaxis(np.asarray(self.upper(lobes, 5)), -1, 0))
        weight, diffuse = self.uniform(3, lobes, 5), self.uniform(3, 5)
        return lobe_system.LobeBrdf(mean, self.uniform(lobes, 5, low=1, high=3), weight, diffuse, (), self.uniform())

    def tensor(self):
        """A BRDF with lobes and terms."""
        lobe, maps = self.lobes(), (self.normal(2, 4, 4), self.normal(3, 4, 4))
        factor = self.normal(len(lobe.weight), 2)
        return dynamic.DynamicBrdf(lobe, self.normal(2, 2, 3), factor, *maps, self.uniform())

    def lamps(self, vertices=2):
        """Transport of two lamps, the first of two pieces."""
        moment = self.uniform(3, vertices), self.uniform(3, vertices), self.normal(3, 3, vertices)
        return LampTransport(*moment, self.normal(vertices, 3), self.rotation(vertices), (0, 0, 1))

    def polygon(self, vertices=4):
        """Directions to corners of a square that nothing looks along, for each vertex."""
        corner = np.array([[-0.6, -0.5, 1], [0.5, -0.7, 1], [0.6, 0.6, 1], [-0.5, 0.4, 1]])[:, :, None]
        corner = corner + 0.1 * np.asarray(self.normal(4, 3, vertices))
        return self.array(corner / np.linalg.norm(corner, axis=1, keepdims=True))

    def mixture(self, lobes=2):
        """Wide lobes on the sphere."""
        return mixture_system.Mixture(self.uniform(lobes), self.unit(lobes), self.uniform(lobes, low=1, high=9))

    def harmonic(self, *nodes):
        """A BRDF in four harmonics, over the view angle or on a map."""
        return harmonic_system.HarmonicBrdf(self.normal(4, 3, *(nodes or (5, 5))), (), self.uniform())

    def matrix(self, vertices=3):
        """Transfer of the same four harmonics."""
        return harmonic_system.TransferMatrix(
            self.normal(vertices, 1, 4, 4), self.normal(vertices, 3), self.rotation(vertices)
        )

    def seen(self, count, size=4):
        """Visibility in sixteenths."""
        return self.integer(17, count, 6 * size * size, dtype=jnp.uint8)

    def above(self, transport):
        """A place that the first vertex of ``sparse`` sees; the others see it or not."""
        position, frame = np.asarray(transport.position), np.asarray(transport.frame)
        return self.array(position[0] + frame[0].T @ (3 * np.asarray(self.upper())))


class Call(NamedTuple):
    """Arrays that a function is called with."""

    position: tuple
    name: dict[str, Any]


class Example(NamedTuple):
    """How one function is called, and what it promises."""

    build: Callable[[Draw], Call]
    gradient: tuple[str, ...] | None
    batch: bool
    options: dict[str, Any]


def call(*position, **name):
    """Arrays, as the function takes them."""
    return Call(position, name)


def example(build, /, *, gradient=None, batch=True, **options):
    """One line of the table."""
    return Example(build, gradient, batch, options)


def model(build, /, **options):
    """One line of the table, for a BRDF at five pairs of directions."""
    return example(lambda draw: call(build(draw), draw.upper(5), draw.upper(5)), **options)


def nothing(draw):
    """No arrays: the function makes a table."""
    return call()


EXAMPLES = {
    "sphere.directions.normalize": example(lambda draw: call(draw.normal(5, 3))),
    "sphere.directions.tangent": example(lambda draw: call(draw.unit(5))),
    "sphere.directions.frame": example(lambda draw: call(draw.unit(5), draw.normal(5, 3))),
    "sphere.directions.view": example(lambda draw: call(draw.rotation(5), draw.normal(5, 3), draw.normal(3))),
    "sphere.directions.to_local": example(lambda draw: call(draw.rotation(2), draw.unit(5))),
    "sphere.cubemap.direction": example(nothing, size=3),
    "sphere.cubemap.point": example(nothing, size=3),
    "sphere.cubemap.solid_angle": example(nothing, size=3),
    "sphere.cubemap.vector_area": example(nothing, size=3),
    "sphere.cubemap.coordinates": example(lambda draw: call(draw.normal(7, 3))),
    "sphere.cubemap.unproject": example(lambda draw: call(draw.integer(6, 7), draw.normal(7), draw.normal(7))),
    "sphere.cubemap.project": example(lambda draw: call(draw.normal(7), draw.normal(7), draw.normal(7))),
    "sphere.cubemap.pad": example(lambda draw: call(draw.normal(6, 3, 3, 2))),
    "sphere.cubemap.reduced": example(lambda draw: call(draw.normal(6, 4, 4, 2)), size=2),
    "sphere.cubemap.lookup": example(lambda draw: call(draw.normal(6, 3, 3, 2), draw.unit(7)), sharpness=2),
    "sphere.hemisphere.disk_coordinates": example(lambda draw: call(draw.upper(5))),
    "benchmarks.published.maps.disk_direction": example(lambda draw: call(draw.uniform(5, 2, low=0.2, high=0.8))),
    "sphere.hemisphere.polar_coordinates": example(lambda draw: call(draw.upper(5))),
    "benchmarks.published.maps.polar_direction": example(lambda draw: call(draw.uniform(5, 2))),
    "sphere.hemisphere.parabolic_coordinates": example(lambda draw: call(draw.upper(5))),
    "sphere.hemisphere.parabolic_direction": example(lambda draw: call(draw.uniform(5, 2))),
    "sphere.hemisphere.lookup": example(lambda draw: call(draw.normal(4, 4, 2), draw.uniform(5, 2))),
    "sphere.hemisphere.arcs": example(lambda draw: call(draw.upper()), rings=3, sectors=4),
    "benchmarks.published.maps.texel_direction": example(nothing, resolution=5),
    "sphere.hemisphere.parabolic_texel_direction": example(nothing, resolution=5),
    "benchmarks.published.maps.texel_area": example(nothing, resolution=5),
    "sphere.hemisphere.parabolic_texel_area": example(nothing, resolution=5),
    "sphere.hemisphere.polar_lookup": example(lambda draw: call(draw.normal(4, 4, 2), draw.uniform(5, 2))),
    "benchmarks.published.maps.polar_texel_direction": example(nothing, resolution=5),
    "benchmarks.published.maps.polar_texel_area": example(nothing, resolution=5),
    "sphere.harmonics.evaluate": example(lambda draw: call(draw.unit(5)), degree=4),
    "sphere.harmonics.reconstruct": example(lambda draw: call(draw.normal(9, 3), draw.unit(5))),
    "sphere.harmonics.project": example(lambda draw: call(draw.normal(6, 3, 3, 2)), degree=3),
    "sphere.harmonics.convolve": example(lambda draw: call(draw.normal(9, 2), draw.normal(3))),
    "sphere.harmonics.cosine": example(nothing, degree=5),
    "sphere.harmonics.phong": example(lambda draw: call(draw.uniform(4, low=1, high=9)), degree=5),
    "sphere.harmonics.hann": example(nothing, degree=5),
    "sphere.harmonics.lanczos": example(nothing, degree=5),
    "sphere.harmonics.natural": example(nothing, degree=5),
    "sphere.harmonics.least_laplacian": example(lambda draw: call(draw.normal(9, 2), draw.uniform())),
    "sphere.low_frequency.product": example(lambda draw: call(draw.normal(9, 3), draw.normal(4, 1)), degree=3),
    "sphere.low_frequency.operator": example(lambda draw: call(draw.normal(9, 2)), degree=2),
    "sphere.low_frequency.triple": example(lambda draw: call(draw.normal(9, 3), draw.normal(4, 1), draw.normal(16, 3))),
    "sphere.low_frequency.irradiance": example(lambda draw: call(draw.normal(9, 3), draw.unit(5))),
    "sphere.low_frequency.dominant_direction": example(lambda draw: call(draw.normal(9, 3))),
    "sphere.low_frequency.directional_light": example(lambda draw: call(draw.normal(9, 3))),
    "sphere.low_frequency.directional_and_ambient": example(lambda draw: call(draw.normal(9, 3))),
    "sphere.harmonics.disc": example(lambda draw: call(draw.unit(4), draw.uniform(4)), degree=4),
    # Derivatives by a rotation are along rotations only; tests of the module's own compare those.
    "sphere.rotation.about_z": example(lambda draw: call(draw.normal(9, 2, 4), draw.normal(4), draw.normal(4))),
    "sphere.rotation.rotate": example(lambda draw: call(draw.normal(9, 2), draw.rotation()), gradient=("coefficient",)),
    "sphere.rotation.rotate_each": example(
        lambda draw: call(draw.normal(9, 2), draw.rotation(4)), gradient=("coefficient",)
    ),
    "sphere.rotation.matrix": example(lambda draw: call(draw.rotation()), gradient=(), degree=2),
    "sphere.hats.integrals": example(lambda draw: call(draw.normal(6, 4, 4, 2)), cells=2),
    "sphere.hats.project": example(lambda draw: call(draw.normal(6, 4, 4, 2)), cells=2),
    "sphere.haar.forward": example(lambda draw: call(draw.normal(3, 4, 4, 2))),
    "sphere.haar.inverse": example(lambda draw: call(draw.normal(3, 4, 4, 2))),
    "sphere.haar.area": example(nothing, size=4),
    "decompose.tucker.multiply": example(lambda draw: call(draw.normal(3, 4, 5), draw.normal(4, 2)), mode=1),
    "decompose.tucker.gram": example(lambda draw: call(draw.normal(3, 4, 5)), mode=1),
    # Gradients of eigenvectors are not promised: they do not exist where eigenvalues repeat.
    "decompose.eigen.symmetric": example(lambda draw: call(draw.symmetric(12)), gradient=(), terms=3, steps=12),
    # One vector at a time amplifies rounding where eigenvalues are alike.
    "decompose.eigen.power": example(lambda draw: call(draw.symmetric(12)), gradient=(), terms=1, steps=40),
    "decompose.eigen.left_singular": example(
        lambda draw: call(draw.array(np.asarray(draw.symmetric(12))[:9]), metric=draw.array(np.eye(12))),
        gradient=(),
        terms=3,
        steps=12,
    ),
    "decompose.mixture.Mixture": example(lambda draw: call(draw.mixture(), draw.unit(5))),
    "decompose.mixture.log_density": example(
        lambda draw: call(draw.unit(5), draw.unit(2), draw.uniform(2, low=0.5, high=9))
    ),
    "decompose.mixture.log_peak": example(lambda draw: call(draw.uniform(5, low=0.5, high=9))),
    "decompose.mixture.drop": example(lambda draw: call(draw.uniform(5, low=0.5, high=9))),
    "decompose.mixture.bands": example(lambda draw: call(draw.uniform(5, low=0.5, high=9)), degree=3),
    "decompose.mixture.concentration_of": example(lambda draw: call(draw.uniform(5))),
    "decompose.mixture.fit": example(
        lambda draw: call(draw.unit(9), draw.uniform(9), draw.mixture(), extent=draw.uniform(9, low=0.01, high=0.02)),
        steps=3,
    ),
    "decompose.mixture.weigh": example(lambda draw: call(draw.normal(9, 2), draw.uniform(9), draw.uniform(2)), steps=3),
    "scene.environment.rotate": example(lambda draw: call(draw.light(2), draw.rotation()), samples=2),
    "scene.light_probes.light_probe": example(lambda draw: call(draw.light()), tool="Unity"),
    "scene.environment.with_suns": example(
        lambda draw: call(draw.light(), (Sun("sun", draw.unit(1)[0], draw.uniform(3)),)), gradient=("light",)
    ),
    "scene.environment.background": example(lambda draw: call(draw.light(), draw.normal(5, 3))),
    "brdf.coat.ClearCoat": model(
        lambda draw: brdf.ClearCoat(
            brdf.MetallicRoughness(draw.uniform(3), draw.uniform(), draw.uniform()), draw.uniform(), draw.uniform()
        )
    ),
    "brdf.coat.CoatedModel": model(
        lambda draw: brdf.CoatedModel(brdf.GGX(draw.uniform(3), draw.uniform(2)), transmits=True)
    ),
    "brdf.sheen.Charlie": model(lambda draw: brdf.Charlie(draw.uniform())),
    "brdf.sheen.UnderSheen": model(
        lambda draw: brdf.UnderSheen(brdf.GGX(draw.uniform(3), draw.uniform(2)), draw.uniform())
    ),
    "brdf.sheen.sheen_albedo": example(lambda draw: call(draw.uniform(5), draw.uniform(5))),
    "brdf.sheen.Sheen": model(
        lambda draw: brdf.Sheen(
            brdf.MetallicRoughness(draw.uniform(3), draw.uniform(), draw.uniform()), draw.uniform(3), draw.uniform()
        )
    ),
    "brdf.models.Lambert": model(lambda draw: brdf.Lambert(draw.uniform(3)), gradient=("self",)),
    "brdf.models.AshikhminShirley": model(
        lambda draw: brdf.AshikhminShirley(draw.uniform(3), draw.uniform(3), 10.0, 60.0)
    ),
    "brdf.measured.HalfDifferenceTable": model(
        lambda draw: brdf.measured.HalfDifferenceTable(draw.uniform(5, 4, 6, 3), draw.uniform())
    ),
    "brdf.measured.MicrofacetTable": model(
        lambda draw: brdf.measured.MicrofacetTable(
            *(draw.uniform(*shape) for shape in ((3,), (3,), (7, 3), (5, 3), (6, 3)))
        )
    ),
    "brdf.models.Phong": model(lambda draw: brdf.Phong(draw.uniform(3), draw.uniform(1), 8.0)),
    "brdf.models.BlinnPhong": model(lambda draw: brdf.BlinnPhong(draw.uniform(3), draw.uniform(1), 20.0)),
    "brdf.models.Ward": model(lambda draw: brdf.Ward(draw.uniform(3), draw.uniform(1), 0.4, 0.7)),
    "brdf.models.WardDuer": model(lambda draw: brdf.WardDuer(draw.uniform(3), draw.uniform(1), 0.4, 0.7)),
    "brdf.models.CookTorrance": model(
        lambda draw: brdf.CookTorrance(draw.uniform(3), draw.uniform(1), 0.5, draw.uniform(3))
    ),
    "brdf.models.Lafortune": model(
        lambda draw: brdf.Lafortune(
            draw.uniform(3),
            *(draw.array(sign * np.asarray(draw.uniform(2, 3))) for sign in (-1, -1, 1)),
            [[5.0], [2.0]],
        )
    ),
    "brdf.varying.PerVertex": model(
        lambda draw: PerVertex(brdf.Phong(draw.uniform(5, 3), draw.uniform(5, 3), draw.uniform(5, 1)))
    ),
    "brdf.varying.Channels": model(
        lambda draw: Channels((brdf.Phong(draw.uniform(1)), brdf.Lambert(draw.uniform(1))), draw.uniform(2))
    ),
    "brdf.microfacet.GGX": model(lambda draw: brdf.GGX(draw.uniform(3), draw.uniform(2), draw.uniform())),
    "brdf.microfacet.GGXInterface": model(
        lambda draw: brdf.GGXInterface(draw.uniform(3), draw.uniform(3), draw.uniform(2))
    ),
    "brdf.microfacet.SchlickDiffuse": model(lambda draw: brdf.SchlickDiffuse(draw.uniform(3))),
    "brdf.microfacet.MetallicRoughness": model(
        lambda draw: brdf.MetallicRoughness(
            draw.uniform(5, 3), *(draw.uniform(5) for _ in range(4)), draw.uniform(3), draw.uniform(5), draw.uniform()
        )
    ),
    "brdf.cylinders.PoulinFournier": model(
        lambda draw: brdf.PoulinFournier(draw.uniform(3), draw.uniform(1), 20.0, 2.5, 0.3)
    ),
    "systems.separable.factorization.SeparableBrdf": model(lambda draw: draw.separable()),
    # Cosines are clipped to [-1, 1], which a direction's own reaches: a table, of no use to derivatives.
    "systems.separable.factorization.light_covariance": example(lambda draw: call(draw.unit(4)), gradient=(), degree=6),
    "systems.harmonic.table.HarmonicBrdf": model(lambda draw: draw.harmonic()),
    "systems.lobe.table.LobeBrdf": model(lambda draw: draw.lobes()),
    "systems.bounces.traced.albedos": example(lambda draw: call(draw.lobes())),
    "systems.dynamic.table.DynamicBrdf": model(lambda draw: draw.tensor()),
    "systems.dynamic.transport.light_factors": example(lambda draw: call(draw.tensor())),
    "systems.bounces.functions.albedo": example(lambda draw: call(draw.separable())),
    "systems.bounces.functions.project": example(lambda draw: call(draw.separable()), degree=2),
    "benchmarks.published.lobes.BrdfSet": model(
        lambda draw: BrdfSet.of([brdf.Phong(draw.uniform(1), draw.uniform(1), exponent) for exponent in (4.0, 9.0)])
    ),
    "benchmarks.published.lobes.Remainder": model(lambda draw: Remainder(brdf.Lambert(draw.uniform(3)), draw.lobes())),
    "systems.harmonic.table.project": example(
        lambda draw: call(brdf.AshikhminShirley(draw.uniform(3), draw.uniform(3), 10.0, 60.0), draw.upper(5)),
        degree=2,
        rings=6,
        sectors=8,
    ),
    "image.raster.ray_direction": example(lambda draw: call(draw.camera())),
    "image.raster.view_axes": example(lambda draw: call(draw.camera())),
    # What is seen is constant for derivatives.
    "image.raster.rasterize": example(lambda draw: call(draw.mesh(), draw.camera()), gradient=()),
    "image.raster.project": example(lambda draw: call(draw.mesh().position, draw.camera())),
    "image.pixels.interpolate": example(
        lambda draw: call(draw.fragments(), draw.mesh().face, draw.normal(6, 2)), gradient=("attribute",)
    ),
    "image.pixels.by_color": example(lambda draw: call(draw.normal(7, 3)), colors=1),
    "image.pixels.resolve": example(
        lambda draw: call(draw.pixels(), draw.normal(60, 3), background=draw.uniform(5, 6, 3)),
        gradient=("color", "background"),
    ),
    "image.pixels.render": example(
        lambda draw: call(draw.mesh(), draw.normal(6, 3), draw.camera(), background=draw.uniform(5, 6, 3)),
        gradient=("color",),  # The background is hidden here.
    ),
    "image.metrics.relative_l2": example(lambda draw: call(draw.normal(4, 5, 3), draw.normal(4, 5, 3))),
    "image.metrics.psnr": example(lambda draw: call(draw.normal(4, 5, 3), draw.normal(4, 5, 3), peak=draw.uniform())),
    "image.tonemap.expose": example(lambda draw: call(draw.uniform(4, 5, 3), stops=draw.normal())),
    "image.tonemap.automatic_exposure": example(lambda draw: call(draw.uniform(4, 5, 3))),
    "image.tonemap.encode_srgb": example(lambda draw: call(draw.uniform(20, low=-0.01, high=1))),
    "image.tonemap.decode_srgb": example(lambda draw: call(draw.uniform(20, low=-0.01, high=1))),
    "image.tonemap.display": example(lambda draw: call(draw.uniform(20, low=-0.01, high=2)), tone="filmic"),
    "systems.separable.sparse.project": example(lambda draw: call(draw.seen(2), draw.rotation(2), draw.separable())),
    "systems.separable.sparse.compress": example(
        lambda draw: call(draw.seen(2), draw.rotation(2), draw.separable()), keep=5
    ),
    # Frames have derivatives along rotations only; see sphere.rotation.
    "systems.bounces.gather.respond": example(
        lambda draw: call(draw.seen(2), draw.rotation(2), draw.separable()), gradient=("basis",), edge=2
    ),
    "systems.bounces.gather.respond_to_lamps": example(
        lambda draw: call(draw.lamps(), draw.rotation(2), draw.separable()), gradient=("basis",)
    ),
    "systems.bounces.gather.respond_again": example(
        lambda draw: call(draw.normal(4, 3, 2), draw.rotation(2), draw.separable()), gradient=("arriving", "basis")
    ),
    "systems.bounces.gather.arrive": example(
        lambda draw: call(
            draw.normal(2, 2, draw.separable().view_map.shape[-1], 4),
            draw.normal(5, 2, 4),
            draw.rotation(5),
            draw.separable(),
            draw.integer(2, 3),
            draw.integer(5, 3, 4, 3),
            draw.uniform(3, 4, 3),
            draw.unit(3, 4),
            draw.normal(3, 4, 2),
        ),
        gradient=("total", "response", "basis", "weight", "measure"),
    ),
    "systems.harmonic.transfer.transfer": example(
        lambda draw: call(draw.seen(2), draw.rotation(2)), gradient=(), degree=2
    ),
    "systems.harmonic.transfer.visible": example(lambda draw: call(draw.seen(2), draw.rotation(2)), degree=2),
    "systems.harmonic.transfer.transfer_diffuse": example(lambda draw: call(draw.seen(2), draw.rotation(2)), degree=2),
    "systems.harmonic.transfer.from_visibility": example(
        lambda draw: call(draw.normal(9, 2), draw.rotation(2)), degree=1, gradient=("coefficient",)
    ),
    "systems.harmonic.transfer.to_visibility": example(
        lambda draw: call(draw.normal(2, 4, 4), draw.rotation(2)), gradient=("matrix",)
    ),
    "systems.harmonic.transfer.right_handed": example(lambda draw: call(draw.rotation(4))),
    # Rounding is constant; what it is relative to is differentiable in dequantize.
    "benchmarks.published.quantized.quantize": example(lambda draw: call(draw.sparse()), gradient=()),
    "benchmarks.published.quantized.dequantize": example(lambda draw: call(quantize(draw.sparse()))),
    "systems.separable.sparse.largest": example(lambda draw: call(draw.normal(2, 9, 2, 3)), keep=4),
    "scene.texture.lookup": example(lambda draw: call(draw.normal(3, 4, 2), draw.normal(5, 2))),
    "scene.points.placed": example(
        lambda draw: call(
            draw.normal(4, 3), draw.rotation(4), Points(jnp.array([[0, 3], [1, 2]]), jnp.full((2, 2), 0.5))
        )
    ),
    # Rounding is constant but for the largest coefficient, which makes steps of all others.
    "benchmarks.published.coefficients.quantize": example(lambda draw: call(draw.normal(24, 3)), gradient=()),
    "systems.reference.integrate": example(
        lambda draw: call(
            draw.seen(2),
            draw.array(np.zeros((2, 3))),
            draw.array(np.broadcast_to(frame := np.asarray(draw.rotation()), (2, 3, 3))),
            brdf.AshikhminShirley(draw.uniform(3), draw.uniform(3), 10.0, 60.0),
            draw.light(),
            draw.array(frame.T @ (3 * np.asarray(draw.upper()))),
        )
    ),
    "systems.bright_texels.split": example(lambda draw: call(draw.light()), count=5),
    "systems.light_cells.split": example(lambda draw: call(draw.light(16))),
    "systems.bright_texels.brightest": example(
        lambda draw: call(draw.light(), least=draw.array(0.0)), count=5, rank=9, gradient=()
    ),
    "systems.bright_texels.without": example(
        lambda draw: call(draw.light(), draw.integer(96, 5), least=draw.array(0.0)), rank=20, gradient=()
    ),
    "systems.lamps.relight.combine": example(lambda draw: call(draw.uniform(2, 3), draw.normal(2, 4, 3))),
    "systems.bright_texels.irradiance": example(
        lambda draw: call(draw.direct(), draw.integer(96, 5), draw.uniform(5, 3)), gradient=("excess",)
    ),
    "systems.bright_texels.radiance": example(
        lambda draw: call(
            each := draw.direct(),
            brdf.AshikhminShirley(draw.uniform(3), draw.uniform(3), 10.0, 60.0),
            draw.integer(96, 5),
            draw.uniform(5, 3),
            eye=draw.above(each),
        ),
        # Frames have derivatives along rotations only; see sphere.rotation.
        gradient=("brdf", "excess", "eye"),
    ),
    "systems.bounces.tensor.scales": example(lambda draw: call((draw.normal(4, 2), draw.normal(2, 3)))),
    "systems.lobe.table.traced_share": example(lambda draw: call(10 + 10 * draw.uniform(5))),
    "systems.lobe.table.traced_visibility": example(lambda draw: call(1000 + 1000 * draw.uniform(5))),
    "sphere.cubemap.coarse": example(lambda draw: call(draw.normal(6, 4, 4, 2)), edge=2),
    "systems.lamps.relight.ray_share": example(
        lambda draw: call(draw.uniform(5, low=2, high=90), draw.uniform(5, low=0.05, high=0.5))
    ),
    "systems.lamps.outline.solid_angle": example(lambda draw: call(draw.polygon())),
    "systems.lamps.outline.above_horizon": example(lambda draw: call(draw.polygon())),
    "systems.lamps.outline.disk": example(lambda draw: call(draw.polygon())),
    "systems.lamps.outline.lobe_integral": example(
        lambda draw: call(
            draw.array(np.moveaxis(np.asarray(draw.upper(2, 4)), -1, 0)),
            draw.uniform(2, 4, low=2, high=90),
            draw.polygon(),
        )
    ),
    "systems.lamps.relight.mean_density": example(
        lambda draw: call(
            jnp.moveaxis(jnp.stack([draw.unit(4), draw.unit(4)]), -1, 0),
            draw.uniform(2, 4, low=0.5, high=90),
            list(draw.unit(4).T),
            draw.uniform(4, low=0.01, high=0.5),
        )
    ),
    "systems.lobe.squares.radiance": example(
        lambda draw: call(
            lobe_system.table.LobeMixture(
                draw.array(np.moveaxis(np.asarray(draw.upper(2, 3)), -1, 0)),
                draw.uniform(2, 3, low=1, high=30),
                draw.uniform(3, 2, 3),
                draw.uniform(3, 3),
            ),
            draw.rotation(3),
            (draw.integer(24, 5), draw.uniform(5, 3), draw.uniform(5, 3)),
            Points(jnp.array([[0, 1, 2], [1, 2, 0]]), jnp.full((2, 3), 0.5)),
        ),
        squares=((2, 3, 1), (2, 2, 1)),
        gradient=("lobe",),
    ),
    "systems.lobe.diffuse.coefficients": example(lambda draw: call(draw.normal(6, 8, 8, 3))),
    "systems.lobe.diffuse.irradiance": example(lambda draw: call(draw.normal(8, 3), draw.normal(8, 5))),
    "systems.lobe.blurred_light.prefilter": example(lambda draw: call(draw.light(8))),
    "systems.lobe.blurred_light.sharpened": example(
        lambda draw: call(lobe_system.blurred_light.prefilter(draw.light(8)), draw.light(32).radiance)
    ),
    "systems.lobe.system.combine": example(
        lambda draw: call(
            lobe_system.blurred_light.prefilter(draw.light(8)),
            lobe_system.system.view_lobes(each := draw.pyramid(), draw.lobes(), eye=draw.above(each)),
        )
    ),
    "systems.harmonic.system.project": example(lambda draw: call(draw.light()), degree=2),
    "systems.harmonic.system.tilted_share": example(lambda draw: call(draw.uniform(5), draw.uniform(5))),
    "benchmarks.published.harmonics.unshadowed_radiance": example(
        lambda draw: call(draw.mesh(), draw.harmonic(), draw.normal(4, 3), eye=draw.camera().eye),
        gradient=("brdf", "light", "eye"),
    ),
    "systems.harmonic.system.probe_light": example(
        lambda draw: call(draw.normal(5, 3), draw.normal(2, 3), draw.normal(2, 4, 3))
    ),
    # Rotations have derivatives along rotations only; see sphere.rotation.
    "systems.harmonic.system.local_light": example(
        lambda draw: call(draw.rotation(5), draw.normal(4, 3)), gradient=("light",)
    ),
    "benchmarks.published.harmonics.world_view": example(
        lambda draw: call(draw.rotation(5), draw.normal(4, 3, 5)), gradient=("view",)
    ),
    "systems.harmonic.system.transferred_light": example(
        lambda draw: call(draw.matrix(), draw.normal(4, 3)), gradient=("light",)
    ),
    "benchmarks.published.harmonics.transferred_view": example(
        lambda draw: call(draw.matrix(), draw.normal(4, 3, 3)), gradient=("view",)
    ),
    "systems.harmonic.system.view_coefficients": example(
        lambda draw: call(draw.harmonic(5), (m := draw.matrix()).position, m.frame, eye=draw.above(m)),
        gradient=("brdf", "position", "eye"),
    ),
    "systems.harmonic.system.blended_view": example(
        lambda draw: call(
            draw.harmonic(5),
            (m := draw.matrix()).position,
            m.frame,
            jaxprt.Blend(draw.normal(3, 3, 2)),
            eye=draw.above(m),
        ),
        gradient=("brdf", "position", "materials", "eye"),
    ),
    "systems.harmonic.system.combine": example(lambda draw: call(draw.normal(4, 3), draw.normal(4, 1, 5))),
    "systems.separable.system.project": example(lambda draw: call(draw.light())),
    "benchmarks.published.coefficients.choose_by_magnitude": example(
        lambda draw: call(draw.normal(24, 3)), threshold=9000
    ),
    "benchmarks.published.coefficients.choose_by_area": example(lambda draw: call(draw.normal(24, 3)), count=7),
    "benchmarks.published.coefficients.choose_by_transport": example(
        lambda draw: call(draw.normal(24, 3), draw.uniform(24)),
        gradient=("coefficient",),  # The weights only choose.
        count=7,
    ),
    "systems.separable.system.light_tuple": example(lambda draw: call(draw.sparse(), draw.light())),
    "systems.separable.system.view_tuple": example(
        lambda draw: call(draw.separable(), (mesh := draw.sparse()).position, mesh.frame, draw.above(mesh))
    ),
    "systems.separable.system.combine": example(lambda draw: call(draw.normal(4, 2, 1), draw.normal(4, 2, 3))),
}


def _public() -> dict[str, Callable]:
    """Public functions, and public classes that can be called, by their name without the package's."""
    result = {}
    packages = ((jaxprt, "jaxprt."), (published, "benchmarks.published."))
    for module in (module for package, name in packages for module in pkgutil.walk_packages(package.__path__, name)):
        if module.name.endswith("__main__"):
            continue
        for name, value in vars(importlib.import_module(module.name)).items():
            if name.startswith("_") or getattr(value, "__module__", None) != module.name:
                continue
            key = f"{module.name.removeprefix('jaxprt.')}.{name}"
            if isinstance(value, type):
                if "__call__" in vars(value):
                    result[key] = value.__call__
            elif callable(value) and hasattr(value, "__qualname__"):
                result[key] = value
    return result


def on_host(name: str) -> bool:
    """Whether HOST names the function or a module that it is in."""
    parts = name.split(".")
    return any(".".join(parts[:count]) in HOST for count in range(1, len(parts) + 1))


PUBLIC = _public()
PURE = [name for name in PUBLIC if not on_host(name)]
TAKING_ARRAYS = [name for name in PURE if name in EXAMPLES and EXAMPLES[name].build is not nothing]
# Their residuals are rounding, and their vectors have either sign: they are held to what they give without jit.
OF_ROUNDING = ["decompose.eigen.symmetric", "decompose.eigen.power", "decompose.eigen.left_singular"]
# The harmonic system has lights of another kind. Jitted functions know no values; their lights were checked before.
RELIGHTING = re.compile(r"systems\..*\.(relight|system|blurred_light)\.")
LIT = [
    name for name in PURE if RELIGHTING.match(name) and "harmonic" not in name and not isinstance(PUBLIC[name], JITTED)
]


@pytest.fixture(scope="module")
def hold(request):
    """The function ``hold(rule, names)``: runs a rule for functions and fails with a list of those that break it."""
    word = request.config.getoption("--only")

    def hold(rule, names):
        offenders = []
        for name in names:
            if word in name and name in EXAMPLES:
                try:
                    rule(name)
                except Exception as error:
                    offenders.append(f"{name}: {type(error).__name__}: {error}")
        assert not offenders, f"{len(offenders)} functions break the rule\n" + "\n\n".join(offenders)

    return hold


def run(name: str, arrays: Call) -> Any:
    """Calls a function with its static options."""
    return PUBLIC[name](*arrays.position, **arrays.name, **EXAMPLES[name].options)


def build(name: str, seed: int = 0) -> Call:
    """Arguments of a function."""
    return EXAMPLES[name].build(Draw(seed))


def bound(name: str, arrays: Call) -> dict[str, Any]:
    """Arguments by the names of the parameters."""
    return dict(inspect.signature(PUBLIC[name]).bind_partial(*arrays.position, **arrays.name).arguments)


def floats(tree: Any) -> list:
    """Floating-point arrays in a tree that hold numbers: those of `VERTICES` hold none."""
    return [leaf for leaf in jax.tree.leaves(tree) if is_float(leaf) and np.size(leaf)]


def is_float(leaf: Any) -> bool:
    """Whether a leaf is a floating-point array, or stands for the shape of one."""
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.inexact)


def is_batched(name: str) -> bool:
    """Whether `jax.vmap` is promised."""
    return EXAMPLES[name].batch and name in TAKING_ARRAYS


def test_every_pure_function_has_an_example():
    missing = [name for name in PURE if name not in EXAMPLES]
    assert not missing, f"add {missing} to EXAMPLES, or to REASONS"


def test_every_example_and_every_exception_is_of_something_public():
    assert not EXAMPLES.keys() - set(PURE)
    modules = {name.rsplit(".", count)[0] for name in PUBLIC for count in (1, 2)}
    assert not HOST.keys() - modules - PUBLIC.keys()


def test_lights_eyes_and_weights_that_are_not_finite_are_refused_by_name(hold):
    def rule(name):
        arguments = bound(name, build(name))
        for key, value in arguments.items():
            if key in ("eye", "weight", "excess") or isinstance(value, scene.Environment):
                broken = jax.tree.map(lambda leaf: with_nan(leaf), value)
                with pytest.raises(ValueError, match=f"the {key}s? must be finite, got 1 of"):
                    PUBLIC[name](**arguments | {key: broken}, **EXAMPLES[name].options)

    hold(rule, LIT)


def with_nan(leaf: Any) -> jax.Array:
    """The array with NaN in its first place."""
    broken = np.array(leaf)
    broken[(0,) * broken.ndim] = np.nan
    return jax.device_put(broken)


def test_defaults_are_keyword_only():
    wrong = [
        f"{name}: {parameter.name}"
        for name, function in PUBLIC.items()
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is not parameter.empty and parameter.kind is not parameter.KEYWORD_ONLY
    ]
    assert not wrong


@functools.cache
def single(name: str) -> tuple[Callable, list[Call], list]:
    """A function as callers use it, compiled whole or in parts, sets of arguments in float32 and their results.

    There are several sets of arguments, of the same shapes, where the function takes batches of them.
    """
    arrays = [build(name, seed) for seed in range(BATCH if is_batched(name) else 1)]

    def function(arrays):
        return run(name, arrays)

    if PUBLIC[name].__name__ == "__call__":
        function = jax.jit(function)
    return function, arrays, [function(one) for one in arrays]


class Double(NamedTuple):
    """What a function compiled whole gives in float64 for the arguments of ``single``, for all sets at once by vmap.

    Where the function is differentiable, the program is of arguments that move, by their names: it gives a weighted sum
    of all results, the results, and derivatives of the sum.
    """

    result: Any
    program: Callable | None
    moving: dict[str, Any]
    gradient: dict[str, Any]


@functools.cache
def double(name: str) -> Double:
    """A function in float64."""
    with jax.enable_x64(True):
        sets = [bound(name, arrays) for arrays in single(name)[1]]
        together = jax.tree.map(lambda *leaf: np.stack(leaf), *sets) if is_batched(name) else sets[0]
        arguments = jax.tree.map(lambda leaf: np.asarray(leaf, float) if is_float(leaf) else leaf, together)
        options, vmap = EXAMPLES[name].options, jax.vmap if is_batched(name) else lambda function: function
        asked = EXAMPLES[name].gradient
        asked = [key for key in arguments if floats(arguments[key])] if asked is None else asked
        if not asked:
            return Double(jax.jit(vmap(lambda all: PUBLIC[name](**all, **options)))(arguments), None, {}, {})
        moving, still = eqx.partition({key: arguments[key] for key in asked}, is_float)
        still = still, {key: value for key, value in arguments.items() if key not in asked}

        def weigh(moving, still):
            result = PUBLIC[name](**still[1] | eqx.combine(moving, still[0]), **options)
            weighed = (jnp.sum(Draw(100 + i).normal(*leaf.shape) * leaf) for i, leaf in enumerate(floats(result)))
            return sum(weighed), result

        program = jax.jit(vmap(jax.value_and_grad(weigh, has_aux=True)))
        (_, result), gradient = program(moving, still)
        return Double(result, lambda moving: program(moving, still)[0][0], moving, gradient)


def test_products_and_those_of_gradients_are_exact_on_gpus(hold, loose):
    def rule(name):
        function, arrays, _ = single(name)
        assert not loose(function, arrays[0])
        wide = double(name)
        if wide.program is not None and name not in OF_ROUNDING:  # JAX's rule for QR states no precision of products.
            with jax.enable_x64(True):
                assert not loose(wide.program, wide.moving)

    hold(rule, PURE)


def test_float32_as_callers_use_it_one_by_one_equals_float64_under_jit_and_vmap(hold, close):
    """Functions that are not compiled whole, but in parts, may look at values or have parts in NumPy without jit."""

    def rule(name):
        results = single(name)[2]
        apart = jax.tree.map(lambda *leaf: np.stack(leaf), *results) if is_batched(name) else results[0]
        jax.tree.map(close, apart, double(name).result)

    hold(rule, [name for name in PURE if name not in OF_ROUNDING])


def test_jit_equals_eager_and_vmap_equals_a_loop_where_results_are_rounding(hold, close):
    def rule(name):
        function, arrays, results = single(name)
        eager = PUBLIC[name].__wrapped__(*arrays[0].position, **arrays[0].name, **EXAMPLES[name].options)
        jax.tree.map(close, results[0], eager)
        together = jax.jit(jax.vmap(function))(jax.tree.map(lambda *leaf: np.stack(leaf), *arrays))
        jax.tree.map(close, together, jax.tree.map(lambda *leaf: np.stack(leaf), *results))

    hold(rule, OF_ROUNDING)


def test_float32_in_gives_float32_out(hold):
    def rule(name):
        _, arrays, results = single(name)
        check_dtype(arrays[0], results[0], jnp.float32)

    hold(rule, PURE)


def test_float64_in_gives_float64_out(hold, x64):
    hold(lambda name: check_dtype(build(name), double(name).result, jnp.float64), PURE)


def check_dtype(arrays, result, dtype):
    """All floating-point arrays of arguments and results have a dtype."""
    assert all(leaf.dtype == dtype for leaf in floats(arrays)), "the example itself must have the dtype"
    result = floats(result)
    assert [leaf.dtype for leaf in result] == [dtype] * len(result)
    assert result, "a function without floating-point results is for REASONS"


def test_gradient_equals_finite_differences(hold, x64):
    def rule(name):
        _, program, moving, gradient = double(name)
        random = Draw(200)
        assert program is not None, "no argument holds floating-point arrays: say gradient=()"
        for key, slope in gradient.items():
            direction = jax.tree.map(lambda leaf: random.normal(*leaf.shape), moving[key])
            norm = np.sqrt(sum(summed(name, np.square(leaf)) for leaf in floats(slope)))
            assert np.isfinite(norm).all(), f"the gradient in {key} is not finite"
            assert norm.all(), f"the gradient in {key} is zero: not what an example is for"
            products = jax.tree.map(lambda *pair: summed(name, np.multiply(*pair)), floats(slope), floats(direction))
            ahead, back = (program(moving | {key: moved(moving[key], direction, step)}) for step in (STEP, -STEP))
            numeric = (ahead - back) / (2 * STEP)
            assert (abs(sum(products) - numeric) <= GRADIENT_TOLERANCE * norm).all(), (
                f"in {key}: {sum(products)}, differences {numeric}"
            )

    hold(rule, [name for name in TAKING_ARRAYS if EXAMPLES[name].gradient != ()])


def summed(name: str, value: Any) -> np.ndarray:
    """Sums over the elements of each set of arguments."""
    value = np.asarray(value)
    return np.sum(value, axis=tuple(range(int(is_batched(name)), value.ndim)))


def moved(tree, direction, step):
    """The arrays a step further along a direction."""
    return jax.tree.map(lambda leaf, along: np.asarray(leaf) + step * np.asarray(along), tree, direction)
