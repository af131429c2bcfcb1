"""Scenes made ready: every part by a system, and the four verbs, radiance and pictures of the whole."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from jaxprt import require
from jaxprt.brdf import BlinnPhong, grid
from jaxprt.compile import Between
from jaxprt.relit import interpolation, measuring, pictures, tracing
from jaxprt.relit import lamps as scene_lamps
from jaxprt.relit.channels import Appearance, Shading, appearance, at_points
from jaxprt.relit.lamps import SceneLamps
from jaxprt.relit.pictures import PictureView
from jaxprt.relit.surface import Surface
from jaxprt.scene import Camera, Environment, Mesh, Scene, TexturedMaterial
from jaxprt.scene.camera import orbit
from jaxprt.scene.points import Points
from jaxprt.systems import protocol
from jaxprt.systems.bounces import PartBounces
from jaxprt.systems.bounces.traced import SharpPart
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.protocol import Blend, Joined, System, Total

RAYS = 8  # of each vertex or point of a sharp part


class SceneView(eqx.Module):
    """A view of a scene.

    Attributes:
        part: The views of its parts, as their systems have them.
        emitted: Radiance that each vertex emits; None where none does.
        lit: Radiance of the vertices of each part in the light of each lamp of radiance 1; None without lamps.
        reflected: What sharp parts show of others, by rays; None without.
    """

    part: tuple[PyTree, ...]
    emitted: Float[Array, "v 3"] | None
    lit: tuple[Float[Array, "n _ _"], ...] | None = None
    reflected: tracing.Reflections | None = None


class SceneLight(eqx.Module):
    """What arrives at a scene with lamps.

    Attributes:
        arriving: Of the environment, as the systems of the parts have it.
        lamp: Radiance of each lamp.
    """

    arriving: PyTree
    lamp: Float[Array, "n 3"]


class RelitScene(System):
    """A scene that is ready to be relit. It is a system itself: its vertices are those of `scene.mesh`, in that order.

    Materials are a dictionary from names of parts to other materials: `TexturedMaterial`, `Appearance` for one that is
    evaluated at the vertices already, or `Blend` for its weights alone. Parts that are not named keep the material that
    they were precomputed with. A part whose material is a BRDF keeps that. Point lights may be among them, by their
    names, with other intensities.

    Attributes:
        scene: The scene.
        direct: The systems of its parts.
        shading: What its parts are to the systems.
        bounces: Light that the parts reflect onto each other; None without.
        lamps: Parts that emit, and point lights; None without. What bounces do not reflect again.
        mesh: The mesh of all parts, with the scene's own normals.
        camera: The scene's first camera; one around it, a little from above, where it has none.
        curvature: How sharp the radiance of each part is, from `jaxprt.relit.interpolation.curvature`.
        points: Where on each part radiance is asked for; None for the vertices.
        mipmapped: Materials of the parts with mip maps of their textures; None for BRDFs.
        lobes: The BRDFs, as lobes, of parts that are too sharp for the harmonics of reflected light; None for others.
        rays: How many rays each vertex or point of these sends for what they reflect.
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
        """Joins the parts' meshes.

        Args:
            scene: The scene.
            direct: The systems of its parts, in order.
            shading: What its parts are to the systems, from `jaxprt.relit.channels.of_part`.
            bounces: Light that the parts reflect onto each other; None without.
            lamps: What the scene's lamps are to its parts; None without.
            lobes: As `RelitScene.lobes` has them; None where no part is sharp.
            rays: As `RelitScene.rays` has it; 0 for reflections by harmonics alone.
        """
        _check_rays(rays)
        # What is no array cannot be an argument of a jitted function.
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
        self.camera = scene.cameras[0] if scene.cameras else orbit(self.mesh, azimuth=0.5, elevation=0.3)

    @property
    def system(self) -> Joined | Total:
        """The system of all vertices, without what they emit: direct light, and bounces where there are any."""
        return self.direct if self.bounces is None else protocol.total(self.direct, self.bounces)

    def light(self, environment: Environment) -> tuple[PyTree, ...]:
        """What a light is to all parts."""
        return self.system.light(environment)

    def shade(self, light: PyTree, materials: Mapping[str, Any] | None = None) -> PyTree:
        """What arrives at all parts."""
        given, changed = scene_lamps.split(self.lamps, materials)
        every = self._all(given)
        arriving = self.system.shade(light, [each.blend for each in every])
        return arriving if self.lamps is None else SceneLight(arriving, self.lamps.radiance(every, changed))

    def view(self, eye: Float[Array, "3"], materials: Mapping[str, Any] | None = None) -> SceneView:
        """What a view and the materials are to all parts.

        Raises:
            TypeError: The materials are no dictionary, one of them is of another kind, or one is of a part whose
                material is a BRDF.
            ValueError: There is no such part, or a material has what was not precomputed; see
                `jaxprt.relit.channels.appearance`.
        """
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

    def combine(self, light: PyTree, view: SceneView) -> Float[Array, "v c"]:
        """Radiance of all vertices, with what they emit."""
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

    def radiance(
        self, environment: Environment, *, eye: Float[Array, "3"], materials: Mapping[str, Any] | None = None
    ) -> Float[Array, "*l v c"]:
        """Radiance that each vertex sends to the eye: `jaxprt.radiance` of this scene."""
        given, changed = scene_lamps.split(self.lamps, materials)
        return protocol.radiance(self, environment, eye=eye, materials={**self.appearances(given), **changed})

    def picture(
        self,
        environment: Environment,
        camera: Camera | None = None,
        *,
        materials: Mapping[str, Any] | None = None,
        samples: int = 4,
        between: Between = None,
    ) -> Float[Array, "h w c"]:
        """The picture of the scene in a light, in linear radiance.

        Radiance is made at the pixels where interpolating it between the vertices would be off by more than 1 %, by the
        sharpness of the material and the size of the triangles in the picture; textures are read at the pixels.

        Args:
            environment: One light, which is seen behind the scene too.
            camera: From where; `self.camera` if None.
            materials: Other materials of some parts.
            samples: Of the coverage of each pixel: 4, or 1 for no anti-aliasing.
            between: Called after each stage and after each row of 8,192 points; an exception that it raises gives the
                picture up. Not inside `jax.jit`.

        Returns:
            The picture. `jaxprt.image.display` makes it fit for the screen.

        Raises:
            TypeError: The light is no Environment, or the camera no Camera.
            ValueError: The light is a batch, or as in `view`.
        """
        view = self._picture_view(camera, materials, samples=samples, keep=False, between=between)
        return view.picture(environment, between=between)

    def picture_view(
        self, camera: Camera | None = None, *, materials: Mapping[str, Any] | None = None, samples: int = 4
    ) -> PictureView:
        """All of a picture but the light, for many lights: `picture_view(camera).picture(environment)`.

        It holds about a kilobyte for each pixel that is shaded. Arguments and errors are those of `picture`.
        """
        return self._picture_view(camera, materials, samples=samples, keep=True, between=None)

    def _picture_view(self, camera: Camera | None, materials, **options: Any) -> PictureView:
        camera = self.camera if camera is None else camera
        require.kind("the camera", camera, Camera, source="jaxprt.scene.camera.orbit")
        materials, changed = scene_lamps.split(self.lamps, materials)
        surfaces = self._surfaces(materials)
        lamp = None if self.lamps is None else self.lamps.radiance([each.appearance for each in surfaces], changed)
        return pictures.make(self.mesh, self.system, surfaces, camera, lamp=lamp, **options)

    def _surfaces(self, materials: Mapping[str, Any] | None) -> list[Surface]:
        """The parts as pictures shade them."""
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
        """The scene with another number of rays for the reflections of its sharp parts; 0 for harmonics alone."""
        _check_rays(rays)
        made = object.__new__(RelitScene)  # Inside of jax.jit too, where nothing can be measured again.
        for field in dataclasses.fields(self):
            object.__setattr__(made, field.name, rays if field.name == "rays" else getattr(self, field.name))
        return made

    def report(self, environments: Sequence[Environment] | None = None) -> measuring.Report:
        """Errors of pictures and parts against the exact sum, times and bytes, measured on this machine.

        Errors are those of direct light alone: of some pixels of pictures from three sides, and of some vertices of
        each part from eight; times and bytes are those of all light.

        Args:
            environments: Lights of one size; the scene's own, or else the two embedded ones.

        Returns:
            The report; `print` shows it as a table.

        Raises:
            ValueError: No lights, lights of different sizes, or NaN or infinity in them.
        """
        lights = measuring.lights_of(self.scene) if environments is None else environments
        alone = RelitScene(self.scene, self.direct, self.shading)
        return measuring.measure(alone.picture, self.camera, self.direct, self.system, self.scene, self.shading, lights)

    def appearances(self, materials: Mapping[str, Any] | None) -> dict[str, Appearance]:
        """Materials evaluated at the vertices: once for all views.

        Args:
            materials: A dictionary from names of parts to materials; None for none.

        Returns:
            The same dictionary with an `Appearance` for each material, which all verbs take.

        Raises:
            TypeError: As in `view`.
            ValueError: As in `view`.
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
            raise ValueError(f"materials must be of the parts {list(known)}, got one of {unknown[0]!r}")
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
                    f"part {name!r} was precomputed without emission, so that its light would not reach other parts: "
                    "precompute the scene with a material that emits"
                )
        return result

    def at(self, points: Sequence[Points]) -> "RelitScene":
        """The scene at points on its parts, one list for each part: `System.at`. Materials stay those of the vertices.

        Raises:
            TypeError: They are no list of points for each part.
            ValueError: Points are not on triangles of their part.
        """
        given = protocol.check_points(points, [len(part.mesh.position) for part in self.scene.parts])
        return eqx.tree_at(lambda each: each.points, self, given, is_leaf=lambda each: each is None)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points."""
        return self._placed.vertices

    @property
    def _placed(self) -> System:
        return self.system if self.points is None else self.system.at(self.points)

    @property
    def shared_light(self) -> tuple | None:
        """What the light of all parts depends on besides the environment."""
        return self.system.shared_light

    def _all(self, materials: Mapping[str, Any] | None) -> list[Appearance]:
        """The appearance of each part: the given one, or that which it was precomputed with."""
        given = self.appearances(materials)
        pairs = zip(self.scene.parts, self.shading, strict=True)
        return [given.get(part.name, Appearance(each.blend, each.emitted)) for part, each in pairs]


def _check_rays(rays: int) -> None:
    if type(rays) is not int or rays < 0:
        raise ValueError(f"rays must be a whole number of at least 0, got {rays!r}")
