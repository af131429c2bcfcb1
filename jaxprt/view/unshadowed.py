"""A scene that a viewer shows before rays are traced: its materials and lights, without shadows."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

from jaxprt.relit.build import shaded
from jaxprt.relit.channels import Shading
from jaxprt.relit.recipes import Recipe
from jaxprt.scene import Camera, Mesh, Scene, sides
from jaxprt.scene.origin import Origin
from jaxprt.scene.scene import centered, default_camera


@dataclasses.dataclass(frozen=True)
class Unshadowed:
    """What a viewer reads of a scene before it is precomputed. The browser's GPU shades it.

    Attributes:
        scene: The scene, with copies of faces whose backs are lit, and its origin at zero.
        origin: Origin of the scene in its files, of which `scene` has none.
        shading: Mesh, BRDF and channel weights of each part.
    """

    scene: Scene
    origin: Origin
    shading: Sequence[Shading]

    bounces = None

    @classmethod
    def of(cls, scene: Scene, recipe: Recipe) -> "Unshadowed":
        """A scene whose parts will be precomputed by one recipe."""
        near = centered(sides.two_sided(scene))
        return cls(near, scene.parts[0].mesh.origin, shaded(near.parts, [recipe] * len(near.parts)))

    @cached_property
    def mesh(self) -> Mesh:
        """The mesh of all parts."""
        return self.scene.mesh

    @cached_property
    def camera(self) -> Camera:
        """The first camera of the scene, or one that shows all of it."""
        return default_camera(self.scene, self.mesh)

    def centered(self) -> "Unshadowed":
        """The scene itself."""
        return self

    def without_bounces(self) -> "Unshadowed":
        """The scene itself."""
        return self
