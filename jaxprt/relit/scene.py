"""Precomputed scenes: systems of groups of parts, and methods for radiance and pictures of the whole scene."""

import dataclasses
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.compile import Between, compile_time, known, promoted, put
from jaxprt.image import automatic_exposure, pixels, raster
from jaxprt.relit import batches, channels, groups, measuring, pictures, reflection, tracing
from jaxprt.relit import lamps as scene_lamps
from jaxprt.relit.casting import caster
from jaxprt.relit.channels import Appearance, Changeable, Shading, appearance
from jaxprt.relit.groups import Arriving, Layout, SceneLight, Stage, Surface
from jaxprt.relit.lamps import SceneLamps
from jaxprt.relit.pictures import PictureView
from jaxprt.relit.refinement import MeshDivision
from jaxprt.relit.surface import Viewed, radiance, view_of
from jaxprt.relit.tracing import Reflections
from jaxprt.scene import Camera, Environment, Mesh, Scene, TexturedMaterial, material_table, sides, subdivision
from jaxprt.scene import mesh as meshes
from jaxprt.scene import origin as origins
from jaxprt.scene import scene as scenes
from jaxprt.scene.material_table import MaterialTable
from jaxprt.scene.points import VERTICES, Points
from jaxprt.systems import axes, protocol
from jaxprt.systems.bounces import GroupBounces
from jaxprt.systems.protocol import Blend, System

RAYS = 8  # reflection rays of each vertex or point of a sharp part


class SceneView(eqx.Module):
    """What depends on the view and the materials of a scene.

    Attributes:
        group: The vertices of each group, or points on it.
        stage: The scene and its materials.
        reflected: Reflections that sharp parts show by ray tracing; None without.
    """

    group: tuple[Viewed, ...]
    stage: Stage
    reflected: Reflections | None = None


class RelitScene(System):
    """A precomputed scene. It is itself a system: its vertices are those of `scene.mesh`, in that order.

    Materials are given as a dictionary from names of parts to new materials. A material is a `TexturedMaterial`, a
    `BlinnPhong` or a `CookTorrance`, an `Appearance` for one that is already evaluated at the vertices, or a `Blend` to
    change only the weights of the BRDF's channels. Parts that are not named keep the material that they were
    precomputed with. A part that was precomputed with another BRDF, or without a range of roughness, cannot change its
    material. The dictionary may also map names of point lights to a `PointLight` with another intensity.

    Attributes:
        scene: The scene.
        shading: Mesh, BRDF and channel weights of each part.
        stage: The groups of parts of one kind, with the materials that they were precomputed with.
        bounces: The system of light that the parts reflect onto each other; None without bounces.
        lamps: Emitting parts and point lights; None if there are none.
        camera: The first camera of the scene. If it has none, a camera that shows the whole scene from slightly above.
            Cameras, eyes and point lights are in the coordinates of the scene's file.
        division: How the meshes were divided; None for the meshes as they were.
        copied: For each part, the vertices of the file that have a copy for their back. The copies follow the file's.
    """

    scene: Scene
    shading: tuple[Shading, ...]
    stage: Stage
    bounces: GroupBounces | None
    lamps: SceneLamps | None
    camera: Camera
    division: MeshDivision | None
    copied: tuple[Int[np.ndarray, " _"], ...]

    def __init__(
        self,
        scene: Scene,
        shading: Sequence[Shading],
        layout: Layout,
        systems: Sequence[System],
        bounces: GroupBounces | None = None,
        *,
        lamps: SceneLamps | None = None,
        rays: int = RAYS,
        division: MeshDivision | None = None,
        copied: Sequence[Int[np.ndarray, " _"]] | None = None,
    ):
        """Joins the parts.

        Args:
            scene: The scene.
            shading: Mesh, BRDF and weights of each part, from `jaxprt.relit.channels.of_part`.
            layout: Where the vertices of the parts stand in the groups.
            systems: The system of each group for direct light.
            bounces: The system of light that the parts reflect onto each other; None without bounces.
            lamps: Emitting parts and point lights, precomputed; None without.
            rays: Number of reflection rays that each vertex or point of a sharp part sends; 0 reflects by harmonics
                alone.
            division: How the meshes of the scene were divided; None if they were not.
            copied: For each part, the vertices that `sides.with_copies` has copied; None for none.
        """
        tracing.check_rays(rays)
        self.division = division
        self.copied = (np.zeros(0, np.int64),) * len(scene.parts) if copied is None else tuple(copied)
        # Values that are not arrays cannot be arguments of a jitted function.
        parts = [
            part
            if isinstance(part.material, TexturedMaterial)
            else dataclasses.replace(part, material=grid.as_argument(part.material))
            for part in scene.parts
        ]
        self.scene = dataclasses.replace(scene, parts=parts)
        self.shading, self.bounces, self.lamps = tuple(shading), bounces, lamps
        mesh, looks = scene.mesh, [part.appearance for part in shading]
        surfaces = tuple(
            groups.surface(
                group,
                shading,
                layout,
                system,
                None if bounces is None else bounces.group[group],
                None if lamps is None else lamps.group[group],
            )
            for group, system in enumerate(systems)
        )
        traits = [reflection.traits(part, surfaces[group]) for part, group in zip(shading, layout.group, strict=True)]
        curvature, samples, sharp = zip(*traits, strict=True)
        emitting = [] if lamps is None else list(lamps.emitting)
        radiance = None if lamps is None else lamps.radiance(looks, {})
        self.stage = Stage(
            mesh,
            groups.padded(mesh),
            surfaces,
            jax.device_put(material_table.of_parts(self.scene.parts)),
            tuple(jax.device_put(layout.gathered(group, looks)) for group in range(len(systems))),
            (None,) * len(systems),
            np.asarray(curvature, mesh.position.dtype),
            layout,
            samples,
            sharp,
            rays,
            tuple(emitting.index(part) if part in emitting else -1 for part in range(len(shading))),
            tuple(sides.hidden_backs(self.scene).tolist()),
            *(((), None) if lamps is None or radiance is None else lamps.sources(radiance, mesh.origin)),
            radiance,
        )
        self.camera = scenes.default_camera(scene, mesh)

    @property
    def mesh(self) -> Mesh:
        """The mesh of all parts, with the original normals (without normal maps)."""
        return self.stage.whole

    @property
    def layout(self) -> Layout:
        """Where the vertices of the parts stand in the groups."""
        return self.stage.layout

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """One `Surface` for each group of parts of one kind."""
        return self.stage.surfaces

    @property
    def file_vertex(self) -> Int[np.ndarray, " _"]:
        """Index in `mesh` of each vertex of the scene before backs were copied and meshes divided, part by part."""
        vertices = [
            np.arange(count - len(copies)) for count, copies in zip(self._whole_counts(), self.copied, strict=True)
        ]
        return np.concatenate([first + index for first, index in zip(self.layout.first, vertices, strict=True)])

    def _whole_counts(self) -> list[int]:
        """Number of vertices of each part with copies for its back, before its mesh was divided."""
        return list(self.layout.counts if self.division is None else self.division.counts)

    def _divided(self, part: int, material: Blend | Appearance) -> Blend | Appearance:
        """Materials at the vertices of a part, copied and interpolated to the added ones if they are of the file's."""
        counts, copies = self._whole_counts(), self.copied[part]
        count = counts[part] - len(copies)
        rows = {len(leaf) for leaf in jax.tree.leaves(material) if np.ndim(leaf)}
        if count == self.layout.counts[part] or rows != {count}:
            return material
        parents = [] if self.division is None else subdivision.part_parents(counts, self.division.parent)[part]
        source = np.concatenate([np.arange(count), copies])
        return jax.tree.map(lambda leaf: jnp.asarray(subdivision.spread(leaf[source], parents)), material)

    def without_bounces(self) -> "RelitScene":
        """The scene without light that its parts reflect onto each other."""
        surfaces = tuple(dataclasses.replace(surface, reflecting=None) for surface in self.surfaces)
        return self._replaced(dataclasses.replace(self.stage, surfaces=surfaces), bounces=None)

    def _replaced(self, stage: Stage, **fields: Any) -> "RelitScene":
        """A copy with another stage. Works inside `jax.jit` too, where `__init__` could not measure the curvature."""
        copy, fields = object.__new__(RelitScene), {**vars(self), "stage": stage, **fields}
        for name, value in fields.items():
            object.__setattr__(copy, name, value)
        return copy

    @promoted
    def light(self, environment: Environment) -> SceneLight:
        """Projects an environment, of one color or three, for the systems of all groups."""
        require.colors("the light", protocol.light_for(self, environment).radiance)
        return groups.light(self.surfaces, self.bounces, environment)

    @promoted
    def shade(self, light: SceneLight, materials: Mapping[str, Any] | Stage | None = None) -> Arriving:
        """The light that arrives at all groups, given the materials. Redone when the light or the materials change."""
        return self._shade(light, self._stage(materials))

    def arriving(
        self,
        stage: Stage,
        environment: Environment,
        direct: Environment | None = None,
        share: Float[np.ndarray, " n"] | None = None,
    ) -> Arriving:
        """The light that arrives under an environment, or another one in direct light, and a share of each lamp."""
        light = self.light(environment)
        if direct is not None:
            light = SceneLight(groups.direct(self.surfaces, direct), light.transferred)
        return self._shade(light, stage, share)

    def _shade(self, light: SceneLight, stage: Stage, share: Float[np.ndarray, " n"] | None = None) -> Arriving:
        """`shade` with a share of the radiance of each lamp; all of it if None."""
        require.kind("the light", light, SceneLight, source="RelitScene.light")
        rows = zip(self.surfaces, light.direct, stage.blends, strict=True)
        direct = [surface.system.shade(lit, blend) for surface, lit, blend in rows]
        if stage.table.frame is not None:
            pairs = zip(self.surfaces, direct, strict=True)
            direct = [surface.system.tilted(lit, surface.frame[:, 2]) for surface, lit in pairs]
        lamp = stage.radiance
        lamp = lamp if lamp is None or share is None else lamp * share[:, None].astype(lamp.dtype)
        reflected = None if self.bounces is None else self.bounces.shade(light.transferred, stage.blends, lamp)
        return Arriving(tuple(direct), reflected, lamp)

    @promoted
    def view(
        self,
        eye: Float[Array | np.ndarray, "3"],
        materials: Mapping[str, Any] | Stage | None = None,
        points: Points | Sequence[Points] = VERTICES,
    ) -> SceneView:
        """The factor of radiance that depends on the eye and the materials, for all groups.

        Args:
            eye: Position of the viewer.
            materials: Dictionary from names of parts to new materials.
            points: A list of the points on each part; by default the vertices. Materials are evaluated at the vertices,
                and interpolated to points.

        Raises:
            TypeError: `materials` is not a dictionary; a material is of a kind that its part does not take; the
                material of its part is a BRDF that cannot change; or `points` is not one list of points for each part.
            ValueError: There is no part of the given name; a material needs something that was not precomputed, see
                `jaxprt.relit.channels.appearance`; or a point is not on a triangle of its part.
        """
        groups.check_points(points, self.scene.counts)
        eye = require.position("the eye", origins.local("the eye", eye, self.mesh.origin))
        stage, seen, starts = self._stage(materials), [], []
        for group, look in enumerate(stage.appearance):
            in_scene, on_group = self.layout.points(group, points)
            if stage.table.frame is not None:
                on_group = on_group.tilted(stage.table.at(in_scene).normal)
            blend, emitted = jax.tree.map(on_group.carry, (look.blend, look.emitted))
            sharp = stage.sharp_at(group, in_scene)
            if sharp is not None:
                if on_group.all_vertices:
                    with compile_time(self.mesh, eye):
                        real = np.arange(len(sharp)) < sum(self.layout.of_group(group, self.layout.counts))
                        sharp = sharp * tracing.facing(self.mesh, eye)[in_scene.corner[0]] * real.astype(sharp.dtype)
                starts.append(tracing.RayOrigins(group, in_scene, on_group, blend, sharp))
            seen.append((on_group, blend, sharp, emitted))
        reflected = tracing.trace(stage, starts, eye, keep=True) if starts else None
        paths, views = iter(() if reflected is None else reflected.paths), []
        for group, (on_group, blend, sharp, emitted) in enumerate(seen):
            missed = None if sharp is None else next(paths).missed
            of_group = view_of(groups.surface_of(stage, group), eye, blend, on_group, sharp, missed=missed)
            views.append(Viewed(on_group, of_group, emitted))
        return SceneView(tuple(views), stage, reflected)

    @promoted
    def combine(
        self, light: Arriving | SceneLight, view: SceneView, points: Points | Sequence[Points] = VERTICES
    ) -> Float[Array, "p c"]:
        """Radiance of all vertices, or of the points of the view, including emission."""
        require.kind("the view", view, SceneView, source="RelitScene.view")
        if isinstance(light, SceneLight) and self.bounces is None and self.lamps is None:
            light = Arriving(light.direct, None, None)  # Materials do not change it.
        light = require.kind("the light", light, Arriving, source="RelitScene.shade")
        traced = iter(()) if view.reflected is None else iter(view.reflected.radiance(view.stage, light))
        colors = []
        for group, (surface, viewed) in enumerate(zip(self.surfaces, view.group, strict=True)):
            surface = groups.sampled(surface, max(self.layout.of_group(group, view.stage.samples)))
            reflections = next(traced) if group in view.stage.sharp_groups else None
            colors.append(radiance(surface, light.at(group), viewed, reflections=reflections))
        return groups.ordered(tuple(colors), self.layout.order(points))

    @promoted
    def under_lights(
        self, lights: Float[Array, "l 6 n n c"], view: SceneView, materials: Any = None, points: Any = VERTICES
    ) -> Float[Array, "l p _"]:
        """Radiance under several lights, by one program for each group: `System.under_lights`."""
        stage = self._stage(materials)
        if view.reflected is not None:  # Rays hit other numbers of points from each eye.
            arriving = (self.arriving(stage, Environment(light)) for light in lights)
            return jnp.stack([self.combine(light, view, points) for light in arriving])
        return batches.radiance(stage, self.bounces, lights, view, self.layout.order(points))

    def _stage(self, materials: Mapping[str, Any] | Stage | None) -> Stage:
        """The scene with given materials, which all methods read."""
        if isinstance(materials, Stage):
            return materials
        of_parts, lights = scene_lamps.split(self.lamps, materials)
        table, new = self._evaluated(of_parts)
        if not new and not lights:
            return self.stage
        stage, names, layout = self.stage, self.scene.names, self.layout
        looks = [new.get(name) or shading.appearance for name, shading in zip(names, self.shading, strict=True)]
        changed = [name in new for name in names]
        traits = list(zip(stage.curvature, stage.samples, stage.sharp, strict=True))
        for part, shading in enumerate(self.shading):
            if changed[part] and shading.table is not None and known(looks[part]):
                shading = dataclasses.replace(shading, blend=looks[part].blend)
                traits[part] = reflection.traits(shading, stage.surfaces[layout.group[part]])
        curvature, samples, sharp = zip(*traits, strict=True)
        appearance = tuple(
            put(layout.gathered(group, looks)) if any(layout.of_group(group, changed)) else look
            for group, look in enumerate(stage.appearance)
        )
        chosen = [name in new and not isinstance(of_parts[name], Changeable) for name in names]
        return dataclasses.replace(
            stage,
            table=table,
            appearance=appearance,
            fixed=tuple(layout.fixed(group, look, chosen) for group, look in enumerate(appearance)),
            curvature=(np if known(curvature) else jnp).asarray(curvature, stage.curvature.dtype),
            samples=samples,
            sharp=sharp,
            radiance=None if self.lamps is None else self.lamps.radiance(looks, lights),
        )

    @promoted
    def radiance(
        self,
        environment: Environment,
        *,
        eye: Float[Array | np.ndarray, "3"],
        materials: Mapping[str, Any] | None = None,
        points: Points | Sequence[Points] = VERTICES,
    ) -> Float[Array, "*l p c"]:
        """Radiance that each vertex or point sends to the eye, including emission; see `jaxprt.radiance`."""
        environment = protocol.light_for(self, environment, batch=True)
        of_parts, changed = scene_lamps.split(self.lamps, materials)
        stage = self._stage({**self.appearances(of_parts), **changed})
        return protocol.radiance(self, environment, eye=eye, materials=stage, points=points)

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
        result = eqx.tree_at(lambda relit: (relit.scene, relit.stage.whole, relit.camera), self, moved)
        if self.lamps is None:
            return result
        return eqx.tree_at(lambda relit: relit.lamps.point_lights, result, result.scene.point_lights)

    @promoted
    def picture(
        self,
        environment: Environment,
        camera: Camera | None = None,
        *,
        materials: Mapping[str, Any] | None = None,
        samples: int = 4,
        shadows: str = "rays",
        background: str | Environment | None = "light",
        layers: Sequence[str] | None = None,
        between: Between = None,
    ) -> Any:
        """Renders the scene under an environment, in linear radiance.

        Materials are evaluated and radiance is computed at each pixel.

        Args:
            environment: One environment.
            camera: The camera; `self.camera` if None.
            materials: Dictionary from names of parts to new materials, in the form that `RelitScene` describes.
            samples: Samples of each pixel: 4, 1 for no anti-aliasing, or 16 for final pictures. 16 takes longer
                than 4, and matters where sharp highlights are smaller than a pixel.
            shadows: "rays" traces shadows of the brightest texels from the points of the picture, so that they are
                sharp on any mesh, and of cells of the light where they differ between vertices. "vertices" interpolates
                visibility between vertices, which is always done where JAX traces the light or the camera. Rays are
                constants of derivatives.
            background: What is seen where no surface is: "light" for the environment, another `Environment`, or None
                for nothing. Without a background the picture has a last channel, alpha, and its colors are those of the
                surfaces times alpha, as in EXR files.
            layers: Names of what to return in a dictionary, instead of the picture alone. "color" is the picture,
                "direct" the light that comes from the environment and from lamps without a reflection on the way, with
                what surfaces emit, and "reflected" the rest: color without a background is their sum. "alpha" is the
                share of each pixel that surfaces hide of the background. "normal" (in world space), "albedo" (the base
                color; white for a part whose material is a BRDF) and "roughness" are means over all samples of a pixel,
                with 0 for those that see no surface, as Blender has them and denoisers take them. "depth" (along the
                direction of view, infinite where nothing is seen), "position" (in world space) and "part" (the index of
                the part, -1 where nothing is seen) cannot be averaged: they are those of the surface that covers most
                of the pixel. `jaxprt.files.write_exr` writes all into one file.
            between: Function that is called after each stage and after each block of 8,192 points. If it raises an
                exception, rendering stops. Not inside `jax.jit`.

        Returns:
            The picture, [h, w, c]; or with `layers` a dictionary of arrays [h, w, c], or [h, w] for single numbers.
            `jaxprt.image.display` converts pictures for a screen.

        Raises:
            TypeError: `environment` is not an `Environment`, `camera` is not a `Camera`, or for the reasons that `view`
                gives.
            ValueError: The environment is a batch or of another size than the scene takes, `samples` is another number,
                `background` or `layers` is none of the above, or for the reasons that `view` gives.
        """
        pictures.check(self, [environment], shadows=shadows)
        view = self._picture_view(camera, materials, samples=samples, keep=False, shadow=shadows, between=between)
        return view.picture(environment, background=background, layers=layers, between=between)

    @promoted
    def pictures(
        self,
        environments: Sequence[Environment],
        cameras: Sequence[Camera],
        *,
        materials: Mapping[str, Any] | None = None,
        samples: int = 4,
        shadows: str = "rays",
        background: str | Environment | None = "light",
        layers: Sequence[str] | None = None,
    ) -> Any:
        """Renders the scene under each of several lights, seen by each of several cameras of one size.

        It is faster than `picture` in a loop: what depends on the view or the light alone is computed once. Lights of
        another size than the scene's are resampled, with a warning. `picture` explains the options.

        Returns:
            Pictures in NumPy, [lights, views, h, w, c]; with `layers` a dictionary of such arrays.

        Raises:
            TypeError: `environments` or `cameras` is not a list of these, or for the reasons of `picture`.
            ValueError: A list is empty, the cameras have different sizes, or for the reasons of `picture`.
            MemoryError: The pictures do not fit into memory; `picture_blocks` gives them one after another.
        """
        batches.check_array(environments, cameras, layers)
        options = {"materials": materials, "samples": samples, "shadows": shadows, "background": background}
        blocks = self.picture_blocks(environments, cameras, layers=layers, **options)
        return batches.stacked(blocks, len(environments), len(cameras))

    def picture_blocks(
        self,
        environments: Sequence[Environment],
        cameras: Sequence[Camera],
        *,
        materials: Mapping[str, Any] | None = None,
        samples: int = 4,
        shadows: str = "rays",
        background: str | Environment | None = "light",
        layers: Sequence[str] | None = None,
        memory: int = 1 << 30,
    ) -> Iterator[batches.PictureBlock]:
        """The pictures of `pictures` in blocks, view by view, for any number of lights and cameras of any sizes.

        `memory` is the number of bytes that the pictures of a block may take. A block has one picture at least.

        Returns:
            Blocks, one after another: the index of the camera, those of the lights, and their pictures in NumPy.

        Raises:
            TypeError: For the reasons of `pictures`, or `memory` is not a number.
            ValueError: For the reasons of `pictures`, or `memory` is not positive.
        """
        batches.check(environments, cameras)
        require.number("memory", memory, 0.0, above=True)
        lights = batches.of_one_size(environments, self.light_size)
        pictures.check(self, lights, shadows=shadows)
        options = {"samples": samples, "keep": False, "shadow": shadows, "between": None}
        view_of = partial(self._picture_view, materials=self._stage(materials), **options)
        return batches.blocks(view_of, lights, cameras, memory=int(memory), background=background, layers=layers)

    @property
    def light_size(self) -> int | None:
        """Edge in texels of the faces of lights that the scene was precomputed for; None if it takes any."""
        return max(surface.system.light_size or 0 for surface in self.surfaces) or None

    @property
    def light_step(self) -> int:
        """See `System.light_step`."""
        return 1 if self.bounces is None else self.bounces.tensor.light_step

    @promoted
    def picture_view(
        self,
        camera: Camera | None = None,
        *,
        materials: Mapping[str, Any] | None = None,
        samples: int = 4,
        shadows: str | Environment = "rays",
    ) -> PictureView:
        """All of a picture that does not depend on the light: `picture_view(camera).picture(environment)` renders it.

        It is faster for many lights, and stores about a kilobyte for each shaded point. Raises what `picture` raises.

        Args:
            camera: As for `picture`.
            materials: As for `picture`.
            samples: As for `picture`.
            shadows: "rays" and "vertices" as in `picture`. With "rays", texels that earlier lights had in common are
                not traced again; cells are. A light traces its brightest texels now, for all pictures of the view, also
                inside of `jax.jit`; its cells are interpolated.
        """
        return self._picture_view(camera, materials, samples=samples, keep=True, shadow=shadows, between=None)

    @promoted
    def coverage(self, camera: Camera | None = None, *, samples: int = 4) -> Float[Array, "h w"]:
        """Fraction of each pixel that shows surfaces and not the environment: the alpha channel of `picture`.

        Args:
            camera: The camera; `self.camera` if None.
            samples: Samples of each pixel: 1, 4 or 16, as in `picture`.

        Raises:
            TypeError: `camera` is not a `Camera`.
            ValueError: `samples` is another number.
        """
        camera = self.camera if camera is None else camera
        require.kind("the camera", camera, Camera, source="jaxprt.scene.camera.orbit")
        samples, camera, fold = pictures.drawn(camera, samples)
        backs = sides.hidden_backs(self.scene)
        hidden = groups.faces_of(self.mesh, np.repeat(backs, self.layout.counts)) if backs.any() else None
        occluder = None if self.mesh.opacity is None else caster(self.mesh).occluder
        options = {"samples": samples, "hidden": hidden, "occluder": occluder}
        cover = pixels.coverage(self.stage.mesh, camera.local(self.mesh.origin), **options)
        return pictures.folded(cover[..., None], fold=fold)[..., 0]

    @promoted
    def exposure(self, picture: Float[Array | np.ndarray, "h w c"], camera: Camera | None = None) -> Float[Array, ""]:
        """Exposure of a picture in stops that brings the brightest surfaces near white, whatever is behind them.

        `jaxprt.image.display(picture, stops=relit.exposure(picture))` shows the picture. It is
        `jaxprt.image.automatic_exposure` with the scene's `coverage`. Pixels whose middle shows a surface that
        emits do not count, unless there are no others.

        Args:
            picture: What `picture` has returned for the camera.
            camera: The camera; `self.camera` if None.

        Raises:
            TypeError: `picture` does not consist of numbers, or `camera` is not a `Camera`.
            ValueError: The picture has another size than the camera, or holds NaN.
        """
        require.array("the picture", picture, "h w 3", "h w 1")
        camera = self.camera if camera is None else camera
        require.kind("the camera", camera, Camera, source="jaxprt.scene.camera.orbit")
        if picture.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"the picture must have the camera's {camera.height} x {camera.width} pixels (rows x columns), got "
                f"{picture.shape[0]} x {picture.shape[1]}: give the camera of the picture"
            )
        picture = jnp.broadcast_to(picture, (*picture.shape[:2], 3))
        coverage = self.coverage(camera)
        if self.lamps is not None and self.lamps.emitting:
            rest = coverage * ~self._glowing(camera)
            coverage = jnp.where(jnp.any(rest > 0), rest, coverage)
        return automatic_exposure(picture, coverage=coverage)

    def _glowing(self, camera: Camera) -> Bool[np.ndarray, "h w"]:
        """Whether the middle of each pixel shows a triangle with a vertex that emits."""
        parts = zip(self.shading, self.layout.counts, strict=True)
        emitted = [
            np.zeros(count) if shading.emitted is None else np.asarray(shading.emitted).max(1)
            for shading, count in parts
        ]
        glowing = np.max(np.concatenate(emitted)[np.asarray(self.mesh.face)], 1) > 0
        triangle = np.asarray(raster.rasterize(self.mesh, camera).triangle)
        return (triangle >= 0) & glowing[np.maximum(triangle, 0)]

    def _picture_view(self, camera: Camera | None, materials, **options: Any) -> PictureView:
        camera = self.camera if camera is None else camera
        require.function("between", options.get("between"))
        require.kind("the camera", camera, Camera, source="jaxprt.scene.camera.orbit")
        return pictures.make(self, self._stage(materials), camera.local(self.mesh.origin), **options)

    def with_rays(self, rays: int) -> "RelitScene":
        """The scene with another number of reflection rays for its sharp parts; 0 reflects by harmonics alone."""
        tracing.check_more_rays(rays, self.stage.rays, self.surfaces)
        return self._replaced(dataclasses.replace(self.stage, rays=rays))

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
        return measuring.measure(self.centered(), lights)

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
        return self._evaluated(materials)[1]

    def _evaluated(self, materials: Mapping[str, Any] | None) -> tuple[MaterialTable, dict[str, Appearance]]:
        """The materials of all parts, some of them new, and those of the new ones at their vertices."""
        if materials is None:
            return self.stage.table, {}
        if not isinstance(materials, Mapping):
            raise TypeError(
                f"the materials must be a dictionary from names of parts to materials, got {type(materials).__name__}"
            )
        names = self.scene.names
        unknown = [name for name in materials if name not in names]
        if unknown:
            raise ValueError(f"materials must be for the parts {names}, got one for {unknown[0]!r}")
        models = {name: material for name, material in materials.items() if isinstance(material, Changeable)}
        table, result = self._table(models), {}
        for name, material in materials.items():
            index = names.index(name)
            part, shading = self.scene.parts[index], self.shading[index]
            if shading.blend is None:
                raise TypeError(
                    f"the material of part {name!r} is a BRDF, which cannot be replaced: precompute the scene with "
                    "another one, with a TexturedMaterial, a BlinnPhong or a CookTorrance"
                )
            kinds, source = (*typing.get_args(Changeable), Appearance, Blend), "jaxprt.scene or RelitScene.appearances"
            require.kind(f"the material of part {name!r}", material, *kinds, source=source)
            if isinstance(material, Changeable):
                first = int(self.layout.first[index])
                vertex = np.arange(first, first + len(part.mesh.position), dtype=np.int32)
                look = table.at(material_table.at_vertices(vertex))
                material = appearance(part, shading, material, look=look)
            else:
                material = self._divided(index, material)
            result[name] = Appearance(material, shading.emitted) if isinstance(material, Blend) else material
            channels.check_blend(name, shading, result[name].blend)
            if not isinstance(result[name].emitted, Tracer | None) and shading.emitted is None:
                raise ValueError(
                    f"part {name!r} was precomputed without emission, so light that it emits would not reach other "
                    "parts: precompute the scene with a material that emits"
                )
        return table, result

    def _table(self, new: Mapping[str, Any]) -> MaterialTable:
        """The materials of all parts with new ones; also their roughness alone, if JAX traces only the rest."""
        before, old = [part.material for part in self.scene.parts], self.stage.table
        after = [new.get(part.name, part.material) for part in self.scene.parts]
        table = put(material_table.with_materials(old, after, before)) if new else old
        if known(table):
            return table
        with compile_time():
            plain = [channels.rough(material) for material in after]
            rough = put(material_table.with_materials(old, plain, before)) if known(plain, old) else None
        return dataclasses.replace(table, rough=rough)

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return sum(self.layout.counts)

    @property
    def shared_light(self) -> tuple | None:
        """Key of the light without bounces; None with them. See `System.shared_light`."""
        keys = tuple(surface.system.shared_light for surface in self.surfaces)
        return None if None in keys or self.bounces is not None else (RelitScene, *keys)

    @property
    def nbytes(self) -> int:
        """Bytes of the systems of all groups, bounces and lamps: transport and BRDFs. Shared arrays count once."""
        return sum({id(leaf): leaf.nbytes for leaf in jax.tree.leaves((self.surfaces, self.bounces))}.values())

    def part_system(self, part: int) -> System:
        """The system of direct light of the vertices of one part, given its index, without padding, in NumPy."""
        if part not in range(len(self.shading)):
            raise ValueError(f"part must be the index of one of {len(self.shading)} parts, got {part!r}")
        first = int(self.layout.start[part])
        return axes.take(self.surfaces[self.layout.group[part]].system, slice(first, first + self.layout.counts[part]))
