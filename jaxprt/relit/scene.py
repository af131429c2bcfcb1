"""Scenes made ready: every part by a system, and the four verbs, radiance and pictures of the whole."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxprt import require
from jaxprt.image import raster
from jaxprt.relit.channels import Shading, blended
from jaxprt.scene import Camera, Environment, Scene, TexturedMaterial
from jaxprt.scene.camera import orbit
from jaxprt.scene.environment import background
from jaxprt.systems import protocol
from jaxprt.systems.protocol import Blend, Joined, System


class RelitScene(System):
    """A scene that is ready to be relit. It is a system itself: its vertices are those of `scene.mesh`.

    Materials are a dictionary from names of parts to other materials: `TexturedMaterial`, or `Blend` for its weights.
    Parts that are not named keep the material that they were made ready with.

    Attributes:
        scene: The scene.
        system: The systems of its parts.
        shading: What its parts are to the systems.
    """

    scene: Scene
    system: Joined
    shading: tuple[Shading, ...]

    def light(self, environment: Environment) -> tuple[PyTree, ...]:
        """What a light is to all parts."""
        return self.system.light(environment)

    def shade(self, light: PyTree, materials: Mapping[str, Any] | None = None) -> PyTree:
        """What arrives at all parts."""
        return self.system.shade(light, self._blends(materials))

    def view(self, eye: Float[Array, "3"], materials: Mapping[str, Any] | None = None) -> tuple[PyTree, ...]:
        """What a view and the materials are to all parts."""
        return self.system.view(eye, self._blends(materials))

    def combine(self, light: PyTree, view: PyTree) -> Float[Array, "v c"]:
        """Radiance of all vertices, with what they emit."""
        color = self.system.combine(light, view)
        if all(each.emitted is None for each in self.shading):
            return color
        zero = jnp.zeros((1, 3), color.dtype)
        emitted = [
            jnp.broadcast_to(zero if each.emitted is None else each.emitted, (len(each.mesh.position), 3))
            for each in self.shading
        ]
        return color + jnp.concatenate(emitted)

    def radiance(
        self, environment: Environment, *, eye: Float[Array, "3"], materials: Mapping[str, Any] | None = None
    ) -> Float[Array, "*l v c"]:
        """Radiance that each vertex sends to the eye: `jaxprt.radiance` of this scene."""
        return protocol.radiance(self, environment, eye=eye, materials=materials)

    def picture(
        self,
        environment: Environment,
        camera: Camera | None = None,
        *,
        materials: Mapping[str, Any] | None = None,
    ) -> Float[Array, "h w c"]:
        """The picture of the scene before its light, in linear radiance.

        Args:
            environment: The light, which is seen behind the scene too.
            camera: From where; the scene's first camera, or else one that sees all of it.
            materials: Other materials of some parts.

        Returns:
            The picture. `jaxprt.image.display` makes it fit for the screen.
        """
        camera = self.camera if camera is None else camera
        require.kind("the camera", camera, Camera, source="jaxprt.scene.camera.orbit")
        color = self.radiance(environment, eye=camera.eye, materials=materials)
        sky = background(environment, raster.ray_direction(camera))
        return raster.render(self.mesh, color, camera, background=sky)

    @property
    def camera(self) -> Camera:
        """The scene's first camera; one around it, a little from above, where it has none."""
        return self.scene.cameras[0] if self.scene.cameras else orbit(self.scene.mesh, azimuth=0.5, elevation=0.3)

    @property
    def mesh(self):
        """The mesh of all parts, with the scene's own normals."""
        return self.scene.mesh

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return self.system.vertices

    @property
    def shared_light(self) -> tuple | None:
        """That of its systems."""
        return self.system.shared_light

    def _blends(self, materials: Mapping[str, Any] | None) -> Sequence[Blend | None]:
        """What the systems of the parts take."""
        if materials is None:
            return [each.blend for each in self.shading]
        if not isinstance(materials, Mapping):
            raise TypeError(
                f"the materials must be a dictionary from names of parts to materials, got {type(materials).__name__}"
            )
        names = [part.name for part in self.scene.parts]
        unknown = [name for name in materials if name not in names]
        if unknown:
            raise ValueError(f"materials must be of the parts {names}, got one of {unknown[0]!r}")
        result = []
        for part, shading in zip(self.scene.parts, self.shading, strict=True):
            given = materials.get(part.name)
            if given is None:
                result.append(shading.blend)
                continue
            if shading.blend is None:
                raise TypeError(f"the material of part {part.name!r} is a BRDF, which was precomputed for good")
            name = f"the material of part {part.name!r}"
            require.kind(name, given, TexturedMaterial, Blend, source="jaxprt.scene.TexturedMaterial")
            result.append(given if isinstance(given, Blend) else blended(part, shading, given))
        return result
