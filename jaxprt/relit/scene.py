"""Precomputed scenes: one system for each part, and methods for radiance and pictures of the whole scene."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from jaxprt import require
from jaxprt.brdf import BlinnPhong, grid
from jaxprt.compile import Between, promoted
from jaxprt.relit import interpolation, measuring, pictures, tracing
from jaxprt.relit import lamps as scene_lamps
from jaxprt.relit.channels import Appearance, Shading, appearance, at_points
from jaxprt.relit.lamps import SceneLamps
from jaxprt.relit.pictures import PictureView
from jaxprt.relit.surface import Surface
from jaxprt.scene import Camera, Environment, Mesh, Scene, TexturedMaterial
from jaxprt.scene import mesh as meshes
from jaxprt.scene import origin as origins
from jaxprt.scene import scene as scenes
from jaxprt.scene.points import Points
from jaxprt.systems import protocol
from jaxprt.systems.bounces import PartBounces
from jaxprt.systems.bounces.traced import SharpPart
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.protocol import Blend, Joined, System, Total

RAYS = 8  # reflection rays of each vertex or point of a sharp part


class SceneView(eqx.Module):
    """What depends on the view and the materials of a scene.

    Attributes:
        part: View of each part, in the form of its system.
        emitted: Radiance that each vertex emits; None if no part emits.
        lit: For each part, radiance of its vertices due to each lamp of unit radiance; None without lamps.
        reflected: Reflections that sharp parts show by ray tracing; None without.
    """

    part: tuple[PyTree, ...]
    emitted: Float[Array, "v 3"] | None
    lit: tuple[Float[Array, "n _ _"], ...] | None = None
    reflected: tracing.Reflections | None = None


class SceneLight(eqx.Module):
    """The light that arrives at a scene with lamps.

    Attributes:
        arriving: Light of the environment, in the form of the parts' systems.
        lamp: Radiance of each lamp; for a point light, its intensity.
    """

    arriving: PyTree
    lamp: Float[Array, "n 3"]


class RelitScene(System):
    """A precomputed scene. It is itself a system: its vertices are those of `scene.mesh`, in that order.

    Materials are given as a dictionary from names of parts to new materials. A material is a `TexturedMaterial` or a
    `BlinnPhong`, an `Appearance` for one that is already evaluated at the vertices, or a `Blend` to change only the
    weights of the BRDF's channels. Parts that are not named keep the material that they were precomputed with. A part
    that was precomputed with another BRDF, or with a `BlinnPhong` and no range of roughness, cannot change its
    material. The dictionary may also map names of point lights to a `PointLight` with another intensity.

    Attributes:
        scene: The scene.
        direct: The systems of the parts, for direct light.
        shading: Mesh, BRDF and channel weights of each part.
        bounces: The system of light that the parts reflect onto each other; None without bounces.
        lamps: Emitting parts and point lights; None if there are none. `bounces` does not include their light.
        mesh: The mesh of all parts, with the original normals (without normal maps).
        camera: The first camera of the scene. If it has none, a camera that shows the whole scene from slightly above.
            Cameras, eyes and point lights are in the coordinates of the scene's file.
        curvature: How fast the radiance of each part varies with direction, from
            `jaxprt.relit.interpolation.curvature`.
        points: Points on each part at which radiance is computed; None for the vertices.
        mipmapped: Material of each part with mipmaps of its textures; None for a part with a BRDF.
        lobes: BRDF, as lobes, of each part whose reflections are too sharp for harmonics; None for other parts.
        rays: Number of reflection rays that each vertex or point of a sharp part sends.
    """

    scene: Scene
    direct: Joined
    shading: tuple[Shading, ...]
    bounces: PartBounces | None
    lamps: SceneLamps | None
    mesh: Mesh
    camera: Camera
    curvature: Float[Array, " n"]
    points: tuple[Points, ...] | None
    mipmapped: tuple[TexturedMaterial | None, ...]
    lobes: tuple[LobeBrdf | None, ...]
    rays: int = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene,
        direct: Joined,
        shading: Sequence[Shading],
        bounces: PartBounces | None = None,
        *,
        lamps: SceneLamps | None = None,
        lobes: Sequence[LobeBrdf | None] | None = None,
        rays: int = RAYS,
    ):
        """Joins the meshes of the parts.

        Args:
            scene: The scene.
            direct: The systems of the parts for direct light, in order.
            shading: Mesh, BRDF and weights of each part, from `jaxprt.relit.channels.of_part`.
            bounces: The system of light that the parts reflect onto each other; None without bounces.
            lamps: Emitting parts and point lights, precomputed; None without.
            lobes: BRDF, as lobes, of each sharp part, and None for other parts. None if no part is sharp.
            rays: Number of reflection rays that each vertex or point of a sharp part sends; 0 reflects by harmonics
                alone.
        """
        tracing.check_rays(rays)
        # Values that are not arrays cannot be arguments of a jitted function.
        parts = [
            part
            if isinstance(part.material, TexturedMaterial)
            else dataclasses.replace(part, material=grid.as_argument(part.material))
            for part in scene.parts
        ]
        self.scene = dataclasses.replace(scene, parts=parts)
        self.direct, self.shading, self.bounces, self.lamps = direct, tuple(shading), bounces, lamps
        self.mesh, self.points, self.rays = scene.mesh, None, rays
        self.lobes = tuple(None for _ in scene.parts) if lobes is None else tuple(lobes)
        self.mipmapped = tuple(
            part.material.mipmapped() if isinstance(part.material, TexturedMaterial) else None for part in scene.parts
        )
        pairs = zip(shading, direct.part, strict=True)
        self.curvature = jnp.asarray([interpolation.curvature(*each) for each in pairs], self.mesh.position.dtype)
        self.camera = scenes.default_camera(scene, self.mesh)

    @property
    def system(self) -> Joined | Total:
        """The system of all vertices without emission: direct light of the environment, and bounces if requested."""
        return self.direct if self.bounces is None else protocol.total(self.direct, self.bounces)

    @promoted
    def light(self, environment: Environment) -> tuple[PyTree, ...]:
        """Projects an environment, of one color or three, for the systems of all parts."""
        colors = protocol.one_light(environment).radiance.shape[-1]
        if colors not in (1, 3):
            raise ValueError(f"the light of a scene must have 1 or 3 colors, got {colors}")
        return self.system.light(environment)

    @promoted
    def shade(self, light: PyTree, materials: Mapping[str, Any] | None = None) -> PyTree:
        """The light that arrives at all parts, given the materials. Redone when the light or the materials change."""
        given, changed = scene_lamps.split(self.lamps, materials)
        every = self._all(given)
        arriving = self.system.shade(light, [each.blend for each in every])
        return arriving if self.lamps is None else SceneLight(arriving, self.lamps.radiance(every, changed))

    @promoted
    def view(self, eye: Float[Array | np.ndarray, "3"], materials: Mapping[str, Any] | None = None) -> SceneView:
        """What depends on the eye and the materials, for all parts.

        Raises:
            TypeError: `materials` is not a dictionary; a material is of a kind that its part does not take; or the
                material of its part is a BRDF that cannot change.
            ValueError: There is no part of the given name, or a material needs something that was not precomputed; see
                `jaxprt.relit.channels.appearance`.
        """
        eye = require.position("the eye", origins.local("the eye", eye, self.mesh.origin))
        materials = scene_lamps.split(self.lamps, materials)[0]
        every = self._all(materials)
        counts = [len(part.mesh.position) for part in self.scene.parts]
        surfaces = self._surfaces(materials)
        if self.points is not None:
            counts = list(map(len, self.points))
            rows = zip(self.scene.parts, self.shading, every, self.points, strict=True)
            every = [at_points(part, shading, own, points) for part, shading, own, points in rows]
        blends, lit = [each.blend for each in every], None
        if self.lamps is not None:
            lit = self.lamps.view(eye, blends, self.points, tracing.traced(self.mesh, surfaces, eye, self.points))
        view, reflected = tracing.split(self.mesh, surfaces, self._placed.view(eye, blends), eye, blends, self.points)
        if all(each.emitted is None for each in every):
            return SceneView(view, None, lit, reflected)
        emitted = [
            jnp.zeros((count, 3), self.mesh.position.dtype) if each.emitted is None else each.emitted
            for count, each in zip(counts, every, strict=True)
        ]
        return SceneView(view, jnp.concatenate(emitted), lit, reflected)

    @promoted
    def combine(self, light: PyTree, view: SceneView) -> Float[Array, "v c"]:
        """Radiance of all vertices, including emission."""
        require.kind("the view", view, SceneView, source="RelitScene.view")
        lamp = None
        if self.lamps is not None and view.lit is not None:
            require.kind("the light", light, SceneLight, source="RelitScene.shade")
            light, lamp = light.arriving, light.lamp
        color = self._placed.combine(light, view.part)
        if self.lamps is not None and lamp is not None and view.lit is not None:
            color = color + self.lamps.combine(lamp, view.lit)
        if view.reflected is not None:
            color = color + tracing.read(view.reflected, self._surfaces(None), light, lamp, self.points)
        return color if view.emitted is None else color + view.emitted

    @promoted
    def radiance(
        self,
        environment: Environment,
        *,
        eye: Float[Array | np.ndarray, "3"],
        materials: Mapping[str, Any] | None = None,
    ) -> Float[Array, "*l v c"]:
        """Radiance that each vertex sends to the eye, including emission; see `jaxprt.radiance`."""
        given, changed = scene_lamps.split(self.lamps, materials)
        return protocol.radiance(self, environment, eye=eye, materials={**self.appearances(given), **changed})

    @property
    def origin(self) -> origins.Origin:
        """Where the scene's zero is in the coordinates of its file."""
        return self.mesh.origin

    def centered(self) -> "RelitScene":
        """The same scene in coordinates relative to its origin, `mesh.origin`, for eyes inside of `jax.jit`.

        A scene whose origin is zero is returned unchanged.
        """
        origin = self.mesh.origin
        if origin == origins.ZERO:
            return self
        moved = scenes.centered(self.scene), meshes.centered(self.mesh), self.camera.local(origin)
        result = eqx.tree_at(lambda each: (each.scene, each.mesh, each.camera), self, moved)
        if self.lamps is None:
            return result
        return eqx.tree_at(lambda each: each.lamps.point_lights, result, result.scene.point_lights)

    @promoted
    def picture(
        self,
        environment: Environment,
        camera: Camera | None = None,
        *,
        materials: Mapping[str, Any] | None = None,
        samples: int = 4,
        between: Between = None,
    ) -> Float[Array, "h w c"]:
        """Renders the scene under an environment, in linear radiance.

        Textures are evaluated at each pixel. Radiance of a part is computed at each pixel if interpolating it between
        vertices would cause an error of more than 1 %, or if the part has more vertices than pixels; otherwise it is
        interpolated. The error is estimated from the sharpness of the material and the size of the triangles.
        Lambertian parts are always interpolated.

        Args:
            environment: One environment. It is also the background.
            camera: The camera; `self.camera` if None.
            materials: Dictionary from names of parts to new materials, in the form that `RelitScene` describes.
            samples: Samples of each pixel: 4, 1 for no anti-aliasing, or 16 for final pictures. 16 takes longer
                than 4, and matters where sharp highlights are smaller than a pixel.
            between: Function that is called after each stage and after each block of 8,192 points. If it raises an
                exception, rendering stops. Not inside `jax.jit`.

        Returns:
            The picture. `jaxprt.image.display` converts it for a screen.

        Raises:
            TypeError: `environment` is not an `Environment`, `camera` is not a `Camera`, or for the reasons that `view`
                gives.
            ValueError: The environment is a batch, `samples` is another number, or for the reasons that `view` gives.
        """
        view = self._picture_view(camera, materials, samples=samples, keep=False, between=between)
        return view.picture(environment, between=between)

    @promoted
    def picture_view(
        self, camera: Camera | None = None, *, materials: Mapping[str, Any] | None = None, samples: int = 4
    ) -> PictureView:
        """All of a picture that does not depend on the light: `picture_view(camera).picture(environment)` renders it.

        It is faster than `picture` for many environments, and stores about a kilobyte for each shaded point. `picture`
        gives the errors.

        Args:
            camera: The camera; `self.camera` if None.
            materials: Dictionary from names of parts to new materials, in the form that `RelitScene` describes.
            samples: Samples of each pixel: 4, 1 for no anti-aliasing, or 16 for final pictures. 16 takes longer
                than 4, and matters where sharp highlights are smaller than a pixel.
        """
        return self._picture_view(camera, materials, samples=samples, keep=True, between=None)

    def _picture_view(self, camera: Camera | None, materials, **options: Any) -> PictureView:
        camera = self.camera if camera is None else camera
        require.function("between", options.get("between"))
        require.kind("the camera", camera, Camera, source="jaxprt.scene.camera.orbit")
        materials, changed = scene_lamps.split(self.lamps, materials)
        surfaces = self._surfaces(materials)
        lamp = None if self.lamps is None else self.lamps.radiance([each.appearance for each in surfaces], changed)
        return pictures.make(self.mesh, self.system, surfaces, camera, lamp=lamp, **options)

    def _surfaces(self, materials: Mapping[str, Any] | None) -> list[Surface]:
        """One `Surface` for each part."""
        given = self.appearances(materials)
        with tracing.now(self.curvature):
            curvature = list(self.curvature)
        surfaces, first = [], 0
        for number, (part, shading, system) in enumerate(
            zip(self.scene.parts, self.shading, self.direct.part, strict=True)
        ):
            own = given.get(part.name, Appearance(shading.blend, shading.emitted))
            material = (materials or {}).get(part.name, self.mipmapped[number])
            material = own if isinstance(material, Blend) else material
            reflecting = None if self.bounces is None else self.bounces.part[number]
            lit = None if self.lamps is None else self.lamps.part[number]
            lamp = None if self.lamps is None else self.lamps.number(number)
            lobes = self.lobes[number]
            if reflecting is not None and lobes is not None and self.rays:
                own_of = reflecting.position, reflecting.frame, reflecting.brdf
                reflecting = SharpPart(*own_of, lobes, self.rays, sent=reflecting.sent)
            surfaces.append(
                Surface(part, first, shading, system, reflecting, lit, own, material, curvature[number], lamp)
            )
            first += len(part.mesh.position)
        return surfaces

    def with_rays(self, rays: int) -> "RelitScene":
        """The scene with another number of reflection rays for its sharp parts; 0 reflects by harmonics alone."""
        tracing.check_rays(rays)
        made = object.__new__(RelitScene)  # Works inside jax.jit too, where __init__ could not measure the curvature.
        for field in dataclasses.fields(self):
            object.__setattr__(made, field.name, rays if field.name == "rays" else getattr(self, field.name))
        return made

    @promoted
    def report(self, environments: Sequence[Environment] | None = None) -> measuring.Report:
        """Measures errors against the exact sum over all texels, times and bytes, on this machine.

        Errors cover direct light only. They are measured at some pixels of pictures from three sides, and at some
        vertices of each part from eight directions. Times and bytes include bounces.

        Args:
            environments: Environments of one size. If None, those of the scene, or the two built-in ones if it has
                none.

        Returns:
            The report; `print` shows it as a table.

        Raises:
            TypeError: `environments` is not a list of `Environment`.
            ValueError: There are no lights, lights of different sizes, or a light that is not finite.
        """
        lights = measuring.lights_of(self.scene) if environments is None else environments
        near = self.centered()
        alone = RelitScene(near.scene, self.direct, self.shading)
        return measuring.measure(alone.picture, near.camera, self.direct, self.system, near.scene, self.shading, lights)

    @promoted
    def appearances(self, materials: Mapping[str, Any] | None) -> dict[str, Appearance]:
        """Evaluates materials at the vertices, so that this is done once for many views.

        Args:
            materials: Dictionary from names of parts to materials; None for an empty one.

        Returns:
            Dictionary from names of parts to `Appearance`. All methods take it in place of `materials`.

        Raises:
            TypeError: For the reasons that `view` gives.
            ValueError: For the reasons that `view` gives, or a material emits light on a part that was precomputed
                without.
        """
        if materials is None:
            return {}
        if not isinstance(materials, Mapping):
            raise TypeError(
                f"the materials must be a dictionary from names of parts to materials, got {type(materials).__name__}"
            )
        known = {part.name: (part, each) for part, each in zip(self.scene.parts, self.shading, strict=True)}
        unknown = [name for name in materials if name not in known]
        if unknown:
            raise ValueError(f"materials must be for the parts {list(known)}, got one for {unknown[0]!r}")
        result = {}
        for name, given in materials.items():
            part, shading = known[name]
            if shading.blend is None:
                raise TypeError(
                    f"the material of part {name!r} is a BRDF, which cannot be replaced: precompute the scene with "
                    "another one, with a TexturedMaterial, or a BlinnPhong with roughness=(low, high)"
                )
            kinds, source = (TexturedMaterial, BlinnPhong, Appearance, Blend), "jaxprt.scene or RelitScene.appearances"
            require.kind(f"the material of part {name!r}", given, *kinds, source=source)
            if isinstance(given, TexturedMaterial | BlinnPhong):
                given = appearance(part, shading, given)
            result[name] = Appearance(given, shading.emitted) if isinstance(given, Blend) else given
            if not isinstance(result[name].emitted, Tracer | None) and shading.emitted is None:
                raise ValueError(
                    f"part {name!r} was precomputed without emission, so light that it emits would not reach other "
                    "parts: precompute the scene with a material that emits"
                )
        return result

    def at(self, points: Sequence[Points]) -> "RelitScene":
        """The same scene at points on its parts instead of the vertices: one list of points for each part.

        Materials are still evaluated at the vertices, and interpolated to the points.

        Raises:
            TypeError: `points` is not one list of points for each part.
            ValueError: A point is not on a triangle of its part.
        """
        given = protocol.check_points(points, [len(part.mesh.position) for part in self.scene.parts])
        return eqx.tree_at(lambda each: each.points, self, given, is_leaf=lambda each: each is None)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points if the scene was moved to points by `at`."""
        return self._placed.vertices

    @property
    def _placed(self) -> System:
        return self.system if self.points is None else self.system.at(self.points)

    @property
    def shared_light(self) -> tuple | None:
        """What `light` depends on besides the environment; see `System.shared_light`."""
        return self.system.shared_light

    def _all(self, materials: Mapping[str, Any] | None) -> list[Appearance]:
        """The appearance of each part: the given one, or that of the material it was precomputed with."""
        given = self.appearances(materials)
        pairs = zip(self.scene.parts, self.shading, strict=True)
        return [given.get(part.name, Appearance(each.blend, each.emitted)) for part, each in pairs]
