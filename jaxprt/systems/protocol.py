"""The four methods of every system, and functions of any system: radiance, sums of systems, bytes.

L = system.light(environment)          call again when the light changes
A = system.shade(L, materials)         call again when the light or, with bounces, the materials change; else A is L
V = system.view(eye, materials)        call again when the eye or the materials change
radiance = system.combine(A, V)        one row per vertex, in the order of the mesh
"""

import abc
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt8

from jaxprt import require
from jaxprt.compile import mapped, promoted
from jaxprt.scene import origin as origins
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import VERTICES, Points, placed

CHANNELS = 4  # most channels of a BRDF's table that exported pages hold
_KNOTS = 64  # most knots of its parameter
# Bytes of what lights of a batch become at all vertices together, and of one at a vertex: some dozen terms of 3 colors.
_ROOM, _PER_VERTEX = 1 << 28, 512


class System(eqx.Module):
    """Precomputed transport and a BRDF in the form that it needs: an immutable pytree with four methods.

    Subclasses document what `light` and `view` return. Each method may be called inside `jax.jit` and is differentiable
    in its arguments.
    """

    @property
    def origin(self) -> origins.Origin:
        """Where the system's zero is in the coordinates of eyes. Only relit scenes may have another than zero."""
        return origins.ZERO

    def centered(self) -> "System":
        """The same system for eyes relative to `origin`."""
        return self

    @abc.abstractmethod
    def light(self, environment: Environment) -> PyTree:
        """Converts an environment to the form of light that this system uses. Call it again when the light changes.

        Raises:
            TypeError: The light is not an `Environment`.
            ValueError: The light is a batch, has another cubemap size than the transport, or is not finite.
        """

    def shade(self, light: PyTree, materials: PyTree = None) -> PyTree:
        """Light that arrives at the vertices. With bounces it depends on the materials; otherwise it is `light`."""
        return light

    def tilted(self, light: PyTree, normal: Float[Array, "v 3"]) -> PyTree:
        """The light with what points need whose normals are tilted by normal maps; by default as it is.

        Args:
            light: The result of `shade`.
            normal: Unit normals of the vertices.
        """
        return light

    @abc.abstractmethod
    def view(self, eye: Float[Array, "3"], materials: PyTree = None, points: Points = VERTICES) -> PyTree:
        """Evaluates the view and the materials in the form that this system uses. Call it again when either changes.

        Args:
            eye: Position of the viewer in world units.
            materials: Materials of the points, as a `Blend` or as the system documents; None for those of the BRDF.
            points: Points on the triangles of the mesh, each with its own position, frame, view and BRDF; by default
                its vertices. A scene takes a list with those of each part.

        Raises:
            TypeError: The materials have a type that the system does not accept, or `points` is something else.
            ValueError: The eye is not one finite position, or the materials do not fit the points, or these do not lie
                on triangles of the mesh.
        """

    @abc.abstractmethod
    def combine(self, light: PyTree, view: PyTree, points: Points = VERTICES) -> Float[Array, "p c"]:
        """Linear radiance that each point sends to the eye, in their order.

        Args:
            light: The result of `shade`; without bounces also that of `light`. It is interpolated to the points.
            view: The result of `view`.
            points: The points of the view.

        Raises:
            TypeError: The light or the view was not made by this kind of system.
        """

    def under_lights(
        self, lights: Float[Array, "l 6 n n c"], view: PyTree, materials: PyTree = None, points: Points = VERTICES
    ) -> Float[Array, "l p _"]:
        """Radiance under several lights by one program.

        Args:
            lights: Radiance of the environments.
            view: The result of `view`.
            materials: Materials of the vertices, for `shade`.
            points: The points of the view.
        """
        return _relit(self, projected(self, lights), view, materials, points)

    @property
    @abc.abstractmethod
    def vertices(self) -> int:
        """Number of vertices."""

    @property
    def matte(self) -> bool:
        """Whether surfaces are ideally diffuse: radiance is linear in the light that arrives at the vertices."""
        return False

    def diffuse_albedo(self, view: PyTree) -> Float[Array, "v c"]:
        """Albedo of the diffuse response, by which irradiance / pi becomes radiance.

        Args:
            view: The result of `view`, which ideally diffuse systems take for the albedo itself.
        """
        if not self.matte:
            raise TypeError(f"{type(self).__name__} has no diffuse response apart from others")
        return view

    @property
    def shared_light(self) -> tuple | None:
        """Key of the result of `light`: systems with equal keys can share it. None if it cannot be shared."""
        return None

    @property
    def lobe_part(self) -> Any:
        """The `jaxprt.lobe.LobeSystem` whose lobes `view` widens by a variance; None if it has none.

        `view` then takes keyword arguments: the variance at points that reflection rays hit, and at others what they
        missed, the share of the rays of narrow lobes that hit nothing. See `LobeSystem.view`.
        """
        return None

    @property
    def degree(self) -> int | None:
        """Degree of the harmonics of the view beyond which radiance has nothing; None if there is no limit."""
        return None

    @property
    def light_size(self) -> int | None:
        """Edge in texels of the faces of lights that the transport was made for; None if it takes any."""
        return getattr(self.growing, "size", None)

    @property
    def light_step(self) -> int:
        """Number that divides the edge of the faces of lights, because the system makes coarser faces of them."""
        return 1

    @property
    def texel_visibility(self) -> Any:
        """Visibility of the single texels whose light is summed exactly, as `BrightTexels` has it; None without."""
        return None

    def exported(self, what: str) -> "Exported":
        """What an exported page holds of the system. Systems without a form of their own can return another system's.

        Args:
            what: What error messages call the system, such as "part 'ball'".

        Raises:
            ValueError: A page cannot show the system. By default it can show none.
        """
        raise ValueError(
            f"{what} must have a system with the method `exported` to be exported, as 'lobe', 'dynamic', 'harmonic' "
            f"and those of ideally diffuse parts, got {type(self).__name__}"
        )

    @property
    def growing(self) -> PyTree:
        """What has a row for each vertex, to estimate bytes."""
        return getattr(self, "transport", self)


class Exported(eqx.Module):
    """What an exported page holds of a system: transport that is stored as bytes, and the table of its BRDF.

    By default surfaces are ideally diffuse, and lit by transfer vectors. Subclasses have transfer matrices, and lobes.

    Attributes:
        system: The system whose transport and BRDF these are.
        vector: Transfer vectors in spherical harmonics; no rows where the page makes transfer matrices.
        visible: Harmonics of the visibility, of twice the degree of the transfer matrices; no rows without matrices.
    """

    system: Any
    vector: Float[np.ndarray, "lm v"]
    visible: Float[np.ndarray, "k v"]

    @property
    def brdf(self) -> Any:
        """The BRDF in the form of the system; None for ideally diffuse surfaces. Equal ones share a table."""
        return None

    @property
    def channels(self) -> int:
        """Number of channels of the table."""
        return 1

    @property
    def weight(self) -> Float[np.ndarray, "k c"]:
        """Weights of the channels of a fixed BRDF: the albedo, or each channel as a color, white for one."""
        if self.brdf is None:
            return np.asarray(self.system.albedo)[None]
        return np.eye(self.channels) if self.channels > 1 else np.ones((1, 3))

    @property
    def degree(self) -> int | None:
        """Degree of the transfer matrices; None without."""
        return None

    @property
    def diffuse(self) -> Float[np.ndarray, "lm v"]:
        """Transfer vectors of an ideally diffuse response, in spherical harmonics."""
        return self.vector

    @property
    def light_size(self) -> int:
        """Edge of the faces of the light that lobes read, in texels; 0 without lobes."""
        return 0

    @property
    def scales(self) -> Any:
        """Scales of the visibility that lobes read, as `jaxprt.systems.lobe.pyramid.Scales`; None without lobes."""
        return None

    @property
    def means(self) -> UInt8[np.ndarray, "v n"]:
        """Mean visibility of the scales that the page holds."""
        return np.zeros((0, 0), np.uint8)

    @property
    def description(self) -> dict[str, Any]:
        """Numbers by which the page's module reads the arrays."""
        knots = getattr(self.brdf, "knot", ())
        knot = np.asarray(knots[0], float).tolist() if knots else []
        return {"lobes": 0, "bands": 0, "words": 0, "steps": 0.0, "knot": knot, "laplacian": 1.0}

    def table(self, what: str) -> Float[np.ndarray, "h q e 4"]:
        """Entries of the BRDF for each knot and view node. `what` names the system in messages."""
        return np.ones((1, 1, 1, 4))

    def check_table(self, what: str) -> None:
        """Refuses tables that a page cannot hold."""
        knots = [len(knot) for knot in self.brdf.knot]
        if not self.brdf.isotropic:
            raise ValueError(f"{what} must have an isotropic BRDF to be exported, got an anisotropic one")
        if self.channels > CHANNELS or len(knots) > 1 or any(count > _KNOTS for count in knots):
            raise ValueError(
                f"{what} must have a table of at most {CHANNELS} channels and one parameter of {_KNOTS} knots to be "
                f"exported, got {self.channels} and {knots}"
            )

    def texel_brdf(self, brdf: Callable) -> Callable:
        """The BRDF by which the page sums single texels, where no blend weights it; `brdf` is that of the part."""
        return brdf

    def with_table(self, table: Any) -> "Exported":
        """The same transport with the BRDF of a `StandardTable`, in place of that under a clear coat or a sheen."""
        return self

    def reduced(self, level: int, degree: int | None) -> "Exported":
        """The same at lower resolution: from a scale of the visibility on, and matrices up to a degree."""
        return self

    def means_by_bits(self) -> "Exported":
        """The same where the page has the bits of texels too, of which it can make means of visibility."""
        return self

    def relit(self) -> System:
        """The system that computes what the page does, from `vector` and `visible` as they are."""
        vector = jnp.asarray(self.vector, jnp.result_type(float))[:, None]
        return eqx.tree_at(lambda system: system.transport.vector, self.system, vector)


class VertexSystem(System):
    """A system for the vertices of one mesh."""

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return len(self.growing.position)

    def placed(self, points: Points) -> tuple[Float[Array, "p 3"], Float[Array, "p 3 3"]]:
        """Positions and frames of points on the mesh, which are checked."""
        check_points(points, self.vertices)
        return placed(self.growing.position, self.growing.frame, points)


def _parameters(value: Any) -> Any:
    """A list of parameters as a tuple of arrays. Anything else is left for `Blend` to refuse."""
    return tuple(map(require.floating, value)) if isinstance(value, list | tuple) else value


class Blend(eqx.Module):
    """Material of each vertex: a weighted sum of basis BRDFs.

    A textured BRDF is a sum of a few fixed gray BRDFs with weights that vary over the surface. The system holds the
    fixed BRDFs as channels, and the blend holds the weights. Radiance is linear in the weights.

    Attributes:
        weight: Weight of each channel k at each vertex, per color c.
        parameter: BRDF parameters of each vertex, such as roughness, one array for each parameter of the table.
    """

    weight: Float[Array, "v k c"] = eqx.field(converter=require.floating)
    parameter: tuple[Float[Array, " v"], ...] = eqx.field(converter=_parameters, default=())

    def __check_init__(self):
        """Refuses weights and parameters that are not finite, and parameters whose length differs from the weights'."""
        require.finite("the weights of the blend", self.weight)
        if jnp.ndim(self.weight) != 3:
            raise ValueError(f"the weights of the blend must be [v, k, c], got {list(jnp.shape(self.weight))}")
        if not isinstance(self.parameter, tuple):
            raise TypeError(
                f"the parameters of the blend must be a list of arrays, got {type(self.parameter).__name__}"
            )
        for value in self.parameter:
            require.finite("the parameters of the blend", value)
            require.length("values of each parameter of the blend", value, len(self.weight))

    def check(self, vertices: int, channels: int) -> None:
        """Refuses a blend with another number of vertices or channels.

        Raises:
            ValueError: The numbers differ.
        """
        if self.weight.shape[:2] != (vertices, channels):
            raise ValueError(
                f"the blend must have weights [{vertices} vertices, {channels} channels, c], "
                f"got {list(self.weight.shape)}"
            )


def albedo_view(system: Any, eye: Float[Array, "*p 3"], blend: Blend | None, points: Points) -> Float[Array, "_ d"]:
    """The view of an ideally diffuse system: the albedo of all points, or of each point with a blend.

    Args:
        system: The system, which has an albedo, gray or per color.
        eye: Position of the viewer in world units, on which the view does not depend.
        blend: Albedo of each point, as weights of one channel; None for that of the system.
        points: The points.

    Raises:
        TypeError: The blend is not a `Blend`, or `points` is something else.
        ValueError: The eye is not finite, or the blend has another number of points or channels.
    """
    check_blend(blend)
    check_points(points, system.vertices)
    count = points.count(system.vertices)
    require.position("the eye", eye, points=count)
    if blend is None:
        return system.albedo[None]
    blend.check(count, 1)
    return blend.weight[:, 0]


def check_blend(value: Any) -> None:
    """Refuses materials that are neither None nor a `Blend`."""
    if value is not None:
        require.kind("the materials", value, Blend, source="jaxprt.systems.protocol.Blend")


class Total(System):
    """The sum of several systems over the same vertices, such as direct and reflected light.

    Attributes:
        part: The systems. All receive the same materials.
    """

    part: tuple[System, ...]

    def __check_init__(self):
        """Refuses systems of different origins or vertices."""
        origin = {system.origin for system in self.part}
        if len(origin) > 1:
            raise ValueError(f"systems must have one origin, got {sorted(origin)}: precompute their parts as one scene")
        counts = [system.vertices for system in self.part]
        if len(set(counts)) != 1:
            raise ValueError(f"systems must be one or more with the same number of vertices, got {counts}")

    @property
    def origin(self) -> origins.Origin:
        """Where the zero of all systems is in the coordinates of eyes."""
        return self.part[0].origin if self.part else origins.ZERO

    def centered(self) -> "Total":
        """The same systems for eyes relative to `origin`."""
        return Total(tuple(system.centered() for system in self.part))

    def light(self, environment: Environment) -> tuple[PyTree, ...]:
        """The light of each system."""
        return tuple(system.light(environment) for system in self.part)

    def shade(self, light: tuple[PyTree, ...], materials: PyTree = None) -> tuple[PyTree, ...]:
        """Light that arrives at the vertices of each system."""
        require.kind("the light", light, tuple, source="Total.light")
        return tuple(system.shade(lit, materials) for system, lit in zip(self.part, light, strict=True))

    def view(self, eye: Float[Array, "3"], materials: PyTree = None, points: Any = VERTICES) -> tuple[PyTree, ...]:
        """The view of each system."""
        return tuple(system.view(eye, materials, points) for system in self.part)

    @promoted
    def combine(
        self, light: tuple[PyTree, ...], view: tuple[PyTree, ...], points: Any = VERTICES
    ) -> Float[Array, "p c"]:
        """The sum of the radiance of all systems."""
        require.kind("the light", light, tuple, source="Total.light")
        require.kind("the view", view, tuple, source="Total.view")
        parts = zip(self.part, light, view, strict=True)
        return sum(
            (system.combine(lit, seen, points) for system, lit, seen in parts),
            start=jnp.zeros((), jnp.result_type(float)),
        )

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return self.part[0].vertices


def check_points(points: Any, vertices: int) -> None:
    """Refuses anything but `Points` on the triangles of a mesh with a number of vertices."""
    require.kind("the points", points, Points, source="jaxprt.scene.points.on_triangles")
    points.check(vertices)


def one_light(value: Any, *, size: int | None = None, batch: bool = False) -> Environment:
    """The light that a system is to relight with, checked, in float32 or float64.

    `size` is the edge of the faces that was precomputed, None for any; with `batch` there may be leading axes.

    Raises:
        TypeError: The value is not an `Environment`.
        ValueError: The light is a batch, has faces of another size, or is not finite.
    """
    require.kind("the light", value, Environment, source="jaxprt.scene.load_environment")
    shape = list(jnp.shape(value.radiance))
    wanted = "n" if size is None else size
    required = f"the light must be one environment [6, {wanted}, {wanted}, c], got {shape}"
    if len(shape) != 4 and not batch:
        raise ValueError(required)
    if size is not None and shape[-3] != size:
        raise ValueError(
            f"{required}: load it with jaxprt.load_environment(path, size={size}), or precompute with size={shape[-3]}"
        )
    require.finite("the light", value.radiance)
    radiance = require.floating(value.radiance)
    return value if radiance is value.radiance else Environment(radiance)


def light_for(taker: Any, value: Any, *, batch: bool = False) -> Environment:
    """`one_light` of a size that a system, or a view, takes by its `light_size` and `light_step`.

    What takes lights calls this before anything else: a view may take seconds, and a light that it does not fit none.
    """
    light = one_light(value, size=taker.light_size, batch=batch)
    if light.radiance.shape[-3] % taker.light_step:
        raise ValueError(
            f"the light must have faces of a multiple of {taker.light_step} texels along an edge, as its reflections "
            f"require, got {light.radiance.shape[-3]}"
        )
    return light


def check_colors(light: int, view: int) -> None:
    """Refuses light and materials of different numbers of colors, unless one of them is gray, by ValueError."""
    if light != view and 1 not in (light, view):
        raise ValueError(
            f"light and materials must have the same number of colors, or one must be gray, got {light} and {view}"
        )


def total(*systems: System) -> Total:
    """The sum of systems over the same vertices, such as `total(direct, bounces)`.

    Raises:
        TypeError: An argument is not a system.
        ValueError: There are no systems, or they have different numbers of vertices.
    """
    for system in systems:
        _check(system)
    return Total(systems)


@promoted
def radiance(
    system: System,
    environment: Environment | PyTree,
    *,
    eye: Float[Array | np.ndarray, "3"],
    materials: PyTree = None,
    points: Any = VERTICES,
) -> Float[Array, "*l p c"]:
    """Radiance that each vertex or point sends to the eye. Calls the four methods of any system in order.

    Args:
        system: The system.
        environment: The light, or a batch of them along leading axes; or one light in another form that the system's
            `light` takes, such as SH coefficients.
        eye: Position of the viewer in world units.
        materials: Materials of the vertices or points, as a `Blend` or as the system documents; None for those of the
            BRDF.
        points: Points on the triangles of the mesh, from `jaxprt.scene.points.on_triangles`; by default its vertices. A
            scene takes a list with those of each part, and materials by part.

    Returns:
        Linear radiance in the light's units, in the order of the points, or of the mesh's vertices. Differentiable in
        the light, the eye and the materials.

    Raises:
        TypeError: The first argument is not a system, the light is not an `Environment`, or the materials have a type
            that the system does not accept.
        ValueError: A batch is empty, or a method of the system raises it.
    """
    _check(system)
    if isinstance(environment, Environment):
        environment = light_for(system, environment, batch=True)
    eye = require.position("the eye", origins.local("the eye", eye, system.origin))
    system = system.centered()
    view = system.view(eye, materials, points)
    batch = environment.radiance.shape[:-4] if isinstance(environment, Environment) else ()
    if not batch:
        return system.combine(system.shade(system.light(environment), materials), view, points)
    if not math.prod(batch):
        raise ValueError(f"a batch of lights must hold at least one, got {list(environment.radiance.shape)}")
    lights = environment.radiance.reshape(-1, *environment.radiance.shape[-4:])
    color = [system.under_lights(block, view, materials, points) for block in _blocks(lights, system.vertices)]
    return jnp.concatenate(color).reshape(*batch, *color[0].shape[1:])


def _blocks(lights: Float[Array, "l 6 n n c"], vertices: int) -> list[Float[Array, "_ 6 n n c"]]:
    """Lights in blocks of about one length that memory holds at once."""
    most = max(1, _ROOM // (_PER_VERTEX * max(1, vertices)))
    return jnp.array_split(lights, -(-len(lights) // most))


def projected(system: System, lights: Float[Array, "l 6 n n c"]) -> PyTree:
    """The results of `light`, along a leading axis, where they depend on the environments alone; else these.

    What depends on the vertices is larger than a processor's cache for many lights, and is computed for each in turn.
    """
    if system.shared_light is None:
        return Environment(lights)
    return jax.vmap(lambda radiance: system.light(Environment(radiance)))(lights)


def arriving(system: System, light: PyTree, materials: PyTree) -> PyTree:
    """The result of `shade` from one of `projected`."""
    return system.shade(system.light(light) if isinstance(light, Environment) else light, materials)


@eqx.filter_jit
def _relit(system: System, light: PyTree, view: PyTree, materials: PyTree, points: Points) -> Float[Array, "l p _"]:
    with jax.default_matmul_precision("highest"):
        return mapped(lambda row: system.combine(arriving(system, row, materials), view, points), light)


def memory(system: System) -> int:
    """Bytes of all arrays of a system: its transport and its BRDF. Shared arrays count once."""
    _check(system)
    return sum(array.nbytes for array in {id(x): x for x in jax.tree.leaves(system) if hasattr(x, "nbytes")}.values())


def _check(system: Any) -> None:
    if not isinstance(system, System):
        raise TypeError(
            "the system must be one of jaxprt, such as jaxprt.lobe.LobeSystem(transport, table), "
            f"got {type(system).__name__}"
        )
