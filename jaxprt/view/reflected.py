"""Light of bounces and lamps in exported pages: what it adds to the irradiance of the vertices, as transfer vectors.

Reflected light is linear in the light of the environment, for the materials that the scene has. The page holds it for
environments of low harmonics, and the light of lamps as it is. Both are reflected diffusely.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxprt import require
from jaxprt.relit.groups import Appearance
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment
from jaxprt.scene.points import Points
from jaxprt.sphere import cubemap, harmonics
from jaxprt.systems.bright_texels import BrightView
from jaxprt.systems.harmonic.exported import upright_cosine
from jaxprt.systems.lamps import LitByLamps
from jaxprt.systems.lobe.system import LobeView
from jaxprt.systems.protocol import System, VertexSystem

DEGREE = 4  # of the light that is reflected: it varies little with the direction of its source
_EDGE = 32  # texels along the edges of environments of one harmonic
_ARRIVING = 3  # degree of the light that arrives from other surfaces
ROWS = (DEGREE + 1) ** 2 + 1  # a row for each harmonic, and one for the light of lamps


def transfer(relit: RelitScene) -> list[Float[np.ndarray, "k 3 _"]] | None:
    """Irradiance / pi that bounces and lamps add at the vertices of each part; None for a scene without both.

    Rows are those of environments of one harmonic, without lamps; the last row is that of the lamps alone.
    """
    if relit.bounces is None and relit.lamps is None:
        return None
    basis = harmonics.evaluate(cubemap.direction(size=_EDGE), degree=DEGREE)
    rows = [_reflected(relit, Environment(basis[..., k, None]), None) for k in range(ROWS - 1)]
    looks = [Appearance(shading.blend, shading.emitted) for shading in relit.shading]
    lamp = None if relit.lamps is None else relit.lamps.radiance(looks, {})
    last = _reflected(relit, Environment(jnp.zeros_like(basis[..., :1])), lamp)
    if relit.lamps is not None and lamp is not None:
        last = [row + _direct(group, lamp) for row, group in zip(last, relit.lamps.group, strict=True)]
    groups = [np.stack(group) for group in zip(*rows, last, strict=True)]
    spans = zip(relit.place.group, relit.place.start, relit.place.counts, strict=True)
    return [groups[number][..., first : first + count] for number, first, count in spans]


def _reflected(
    relit: RelitScene, light: Environment, lamp: Float[Array, "n 3"] | None
) -> list[Float[np.ndarray, "3 _"]]:
    """Irradiance / pi of reflected light at the vertices of each group."""
    if relit.bounces is None:
        return [np.zeros((3, count)) for count in relit.place.size]
    blends = [look.blend for look in relit.appearance]
    arriving = relit.bounces.shade(relit.bounces.light(light), blends, lamp)
    factor, zonal = upright_cosine(_ARRIVING), np.arange(_ARRIVING + 1)
    rows = [np.asarray(group, np.float64)[zonal * (zonal + 1)] for group in arriving]
    return [np.broadcast_to(np.einsum("l,lcv->cv", factor, row), (3, row.shape[2])) for row in rows]


def _direct(group: LitByLamps, lamp: Float[Array, "n 3"]) -> Float[np.ndarray, "3 v"]:
    """Irradiance / pi of the light of lamps at the vertices of a group."""
    white = LitByLamps(group.transport)
    return np.asarray(white.combine(lamp, white.view(jnp.zeros(3))), np.float64).T


class ReflectingLight(eqx.Module):
    """The light of a `ReflectingSystem`.

    Attributes:
        direct: The light of the system of direct light.
        irradiance: Irradiance / pi of the vertices from bounces and lamps.
    """

    direct: PyTree
    irradiance: Float[Array, "c v"]


class ReflectingSystem(VertexSystem):
    """A system of direct light with what bounces and lamps add to its irradiance, as an exported page computes it.

    Attributes:
        direct: The system of direct light: lobes or ideally diffuse, with or without single texels.
        vector: The transfer of a part, from `transfer`.
    """

    direct: System
    vector: Float[Array, "k 3 v"]

    def light(self, environment: Environment) -> ReflectingLight:
        """The light of the system of direct light, and the irradiance of reflected light."""
        coefficient = harmonics.project(environment.radiance, degree=DEGREE)
        coefficient = jnp.broadcast_to(coefficient, (len(coefficient), 3))
        irradiance = jnp.einsum("kc,kcv->cv", coefficient, self.vector[:-1], precision="highest") + self.vector[-1]
        return ReflectingLight(self.direct.light(environment), irradiance)

    def shade(self, light: ReflectingLight, materials: PyTree = None) -> ReflectingLight:
        """Light that arrives at the vertices. Materials do not change it."""
        return ReflectingLight(self.direct.shade(light.direct, materials), light.irradiance)

    def tilted(self, light: ReflectingLight, normal: Float[Array, "v 3"]) -> ReflectingLight:
        """The light, whose reflected part arrives alike at tilted normals: `System.tilted`."""
        return ReflectingLight(self.direct.tilted(light.direct, normal), light.irradiance)

    def view(self, eye: Float[Array, "*p 3"], materials: PyTree = None) -> PyTree:
        """The view of the system of direct light, which has the albedo of the diffuse response."""
        return self.direct.view(eye, materials)

    def combine(self, light: ReflectingLight, view: PyTree) -> Float[Array, "v c"]:
        """Radiance: direct light, and irradiance times the albedo of the diffuse response."""
        require.kind("the light", light, ReflectingLight, source="ReflectingSystem.light")
        shown = view.rest if isinstance(view, BrightView) else view
        albedo = shown.diffuse.T if isinstance(shown, LobeView) else shown
        return self.direct.combine(light.direct, view) + self.carried(light.irradiance, axis=1).T * albedo

    def at(self, points: Points) -> "ReflectingSystem":
        """The system at points; see `System.at`."""
        changed = points, self.direct.at(points)
        return eqx.tree_at(
            lambda system: (system.points, system.direct), self, changed, is_leaf=lambda leaf: leaf is None
        )

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points where radiance is evaluated at points."""
        return self.direct.vertices

    @property
    def matte(self) -> bool:
        """Whether the system of direct light is ideally diffuse."""
        return self.direct.matte

    @property
    def texel_edge(self) -> int | None:
        """That of the system of direct light."""
        return self.direct.texel_edge

    @property
    def placement(self) -> tuple[Array | np.ndarray, Array | np.ndarray] | None:
        """That of the system of direct light."""
        return self.direct.placement

    def with_samples(self, samples: int) -> "ReflectingSystem":
        """The same with another number of sample points along the edge of each bright texel."""
        return eqx.tree_at(lambda system: system.direct, self, self.direct.with_samples(samples))
