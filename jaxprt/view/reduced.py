"""Relit scenes as exported pages hold them: direct light, transport as bytes, and visibility at lower resolution."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxprt import require
from jaxprt.brdf import ClearCoat, Sheen
from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import put
from jaxprt.relit import channels
from jaxprt.relit.channels import Shading
from jaxprt.relit.groups import Layout
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Part, Scene, TexturedMaterial
from jaxprt.systems import axes, standard
from jaxprt.systems.bounces import exported
from jaxprt.systems.bright_texels import BrightTexels
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.lobe.exported import lobe_description, lobe_entries
from jaxprt.systems.lobe.pyramid import Scales
from jaxprt.systems.protocol import Blend, Exported, System
from jaxprt.systems.standard.layered import BASE
from jaxprt.view import reflected

FIRST = 2  # finest scale of visibility that is stored as bytes
MOST_BYTES = 2**27  # largest buffer that graphics cards accept
_METAL = 0.5  # mean metalness above which lamps are seen by their highlights
_GRAY = 0.5  # albedo that stands for a BRDF without a standard table
_TEXELS = 64  # number of brightest texels that are summed one by one


@dataclasses.dataclass(frozen=True)
class PageScene:
    """A scene as an exported page holds it: bounces and lamps for diffuse responses only, no clear coats and sheens.

    Attributes:
        scene: The scene.
        shading: Mesh, BRDF and channel weights of each part.
        parts: What the page holds of the system of each part.
        texels: Visibility of single texels for each part, None for parts without; None if a part with lobes or all
            parts lack it, or if the page does not sum single texels.
        level: Finest scale of the visibility of lobes.
        unshadowed: Edge of the faces of the light, if nothing of the visibility is known and the page shows the scene
            without shadows; 0 with visibility.
        reflected: What bounces and lamps add to the irradiance of each part, from `jaxprt.view.reflected.transfer`,
            without rows for parts with transfer matrices; None for a scene without both.
    """

    scene: Scene
    shading: Sequence[Shading]
    parts: Sequence[Exported]
    texels: Sequence[Any] | None
    level: int = 0
    unshadowed: int = 0
    reflected: Sequence[Float[np.ndarray, "_ 3 _"]] | None = None

    @classmethod
    def without_visibility(cls, parts: Sequence[Part], shadings: Sequence[Shading], size: int) -> "PageScene":
        """A scene before rays are traced. Compiles no program.

        Args:
            parts: The parts of the scene.
            shadings: Their shading. BRDFs without a standard table become gray diffuse surfaces.
            size: Edge of the faces of the light.
        """
        rows = [_unshadowed(part, shading, size) for part, shading in zip(parts, shadings, strict=True)]
        parts, shadings, pages = zip(*rows, strict=True)
        return cls(Scene(list(parts)), shadings, pages, None, unshadowed=size)

    @classmethod
    def of(cls, relit: RelitScene) -> "PageScene":
        """All that a page can show of a scene. One warning names the parts that lose a clear coat or a sheen."""
        names = relit.scene.names
        systems = [axes.map_leaves(relit.part_system(n), lambda _, leaf: put(leaf)) for n in range(len(names))]
        parts = [system.exported(f"part {name!r}") for name, system in zip(names, systems, strict=True)]
        pairs = zip(systems, parts, strict=True)
        texels = [None if part.degree is not None else system.texel_visibility for system, part in pairs]
        texels = [seen if hasattr(seen, "packed") else None for seen in texels]
        lacking = [part.scales is not None for part, seen in zip(parts, texels, strict=True) if seen is None]
        seen = None if any(lacking) or len(lacking) == len(parts) else texels
        scene, shading, layered = relit.scene, relit.shading, [shading.layered for shading in relit.shading]
        added = reflected.transfer(relit)
        if added is not None:
            added = [rows if part.degree is None else rows[:0] for rows, part in zip(added, parts, strict=True)]
        if not any(layered):
            return cls(scene, shading, parts, seen, reflected=added)
        lost = ", ".join(repr(name) for name, has in zip(names, layered, strict=True) if has)
        warnings.warn(f"the page shows these parts without their clear coats and sheens: {lost}", stacklevel=3)
        rows = list(zip(layered, scene.parts, shading, parts, strict=True))
        scene = dataclasses.replace(scene, parts=[_bare(part) if has else part for has, part, *_ in rows])
        shading = [_base_shading(shading) if has else shading for has, _, shading, _ in rows]
        parts = [part.with_table(standard.METALLIC_ROUGHNESS) if has else part for has, *_, part in rows]
        return cls(scene, shading, parts, seen, reflected=added)

    @classmethod
    def for_gpu(cls, relit: RelitScene) -> "PageScene":
        """All that a page can show of a scene without bounces, as finely as graphics cards hold it."""
        rows = zip(relit.scene.names, relit.scene.parts, strict=True)
        if relit.lamps is not None and (metals := [name for name, part in rows if _shines(part.material)]):
            raise ValueError(f"lamps shine on these parts by highlights: {', '.join(map(repr, metals))}")
        if layered := [name for name, row in zip(relit.scene.names, relit.shading, strict=True) if row.layered]:
            raise ValueError(f"these parts have clear coats or sheens: {', '.join(map(repr, layered))}")
        page = cls.of(relit.without_bounces())
        pairs = [] if page.reflected is None else zip(relit.scene.names, page.reflected, strict=True)
        if unlit := [name for name, rows in pairs if not len(rows)]:
            raise ValueError(f"lamps light these parts through transfer matrices: {', '.join(map(repr, unlit))}")
        scale, level = page.scales, FIRST
        if scale is None:
            return page.reduced(0, texels=False)
        count = sum(part.vector.shape[1] for part in page.parts if part.scales is not None)
        while count * int(scale.total - scale.start[level]) > MOST_BYTES and level < len(scale.edge) - 1:
            level += 1
        fits = page.holds_texels
        return page.reduced(level, texels=fits)

    def reduced(self, level: int, *, texels: bool, degree: int | None = None) -> "PageScene":
        """The scene at lower resolution, with vectors and matrices that bytes can hold.

        Args:
            level: Finest scale of visibility, as `jaxprt.systems.lobe.pyramid.scales` numbers them.
            texels: Whether the brightest texels of the light are summed one by one, on the parts that support it.
            degree: Highest degree of the transfer matrices; None keeps their degree.
        """
        parts = [part.reduced(level, degree) for part in self.parts]
        if texels:
            parts = [part.means_by_bits() for part in parts]
        vectors, visible = ([getattr(part, name) for part in parts] for name in ("vector", "visible"))
        rounded = zip(parts, _rounded(vectors), _rounded(visible), strict=True)
        parts = [dataclasses.replace(part, vector=vector, visible=seen) for part, vector, seen in rounded]
        added = None if self.reflected is None else _rounded(self.reflected)
        seen = self.texels if texels else None
        return dataclasses.replace(self, parts=parts, texels=seen, level=level, reflected=added)

    def with_reflected(self, *, bounces: bool, lamps: bool) -> "PageScene":
        """The scene with only some of what bounces and lamps add; the form of the arrays stays."""
        if self.reflected is None:
            return self
        added = []
        for rows in self.reflected:
            keep = np.full(len(rows), float(bounces))
            keep[-1:] = lamps
            added.append(rows * keep[:, None, None])
        return dataclasses.replace(self, reflected=added)

    def relit(self) -> RelitScene:
        """The scene as the page relights it."""
        systems: list[System] = [part.relit() for part in self.parts]
        if self.texels is not None:
            rows = zip(systems, self.texels, self.parts, self.shading, strict=True)
            systems = [
                system if seen is None else _with_texels(system, seen, part, shading)
                for system, seen, part, shading in rows
            ]
        if self.reflected is not None:
            pairs = zip(systems, self.reflected, strict=True)
            systems = [
                exported.ReflectingSystem(system, put(rows.astype(jnp.result_type(float)))) if len(rows) else system
                for system, rows in pairs
            ]
        return RelitScene(self.scene, self.shading, Layout.apart(self.scene.counts), systems)

    @property
    def bits(self) -> list[UInt8[np.ndarray, "v n"]] | None:
        """Visibility of single texels for each part, without any for parts that lack it; None without single texels."""
        if self.texels is None:
            return None
        return [np.zeros((0, 0), np.uint8) if seen is None else seen.packed for seen in self.texels]

    @property
    def holds_texels(self) -> bool:
        """Whether graphics cards hold the visibility of single texels."""
        return self.bits is not None and sum(words.size for words in self.bits) <= MOST_BYTES

    @property
    def texel_edge(self) -> int:
        """Edge of the faces of the light whose brightest texels are summed one by one; 0 if none are."""
        if self.unshadowed:
            return self.unshadowed
        return 0 if self.texels is None else next(seen.size for seen in self.texels if seen is not None)

    @property
    def scales(self) -> Scales | None:
        """Scales of the visibility of parts with lobes; None without such parts."""
        return next((part.scales for part in self.parts if part.scales is not None), None)

    @property
    def light_size(self) -> int:
        """Texels along a face's edge of the light that lobes read; 0 without lobes."""
        return max(part.light_size for part in self.parts)


class UnshadowedLobes(Exported):
    """What a page holds of a part before rays are traced: the lobes of its material.

    Attributes:
        table_lobes: The lobes; None for an ideally diffuse surface.
        albedo: Color of an ideally diffuse surface.
        size: Edge of the faces of the light, in texels.
    """

    table_lobes: LobeBrdf | None
    albedo: Float[np.ndarray, "3"]
    size: int = eqx.field(static=True)

    @property
    def brdf(self) -> LobeBrdf | None:
        """The table of lobes."""
        return self.table_lobes

    @property
    def channels(self) -> int:
        """Number of channels of the table."""
        return 1 if self.table_lobes is None else len(self.table_lobes.weight)

    @property
    def weight(self) -> Float[np.ndarray, "1 3"]:
        """The color of an ideally diffuse surface."""
        return self.albedo[None]

    @property
    def light_size(self) -> int:
        """Edge of the faces of the light, in texels: all surfaces read the blurred light."""
        return self.size

    @property
    def description(self) -> dict[str, Any]:
        """Numbers by which the page's module reads the table."""
        return super().description | ({} if self.brdf is None else lobe_description(self.brdf))

    def table(self, what: str) -> Float[np.ndarray, "h q e 4"]:
        """Entries of the table of lobes."""
        return super().table(what) if self.brdf is None else lobe_entries(self.brdf)


def _unshadowed(part: Part, shading: Shading, size: int) -> tuple[Part, Shading, UnshadowedLobes]:
    """A part with the material that it has in a page without visibility, its shading, and what the page holds of it."""
    if shading.layered:
        part, shading = _bare(part), _base_shading(shading)
    material = part.material
    if isinstance(material, TexturedMaterial) and shading.table is None and not shading.matte:
        part = dataclasses.replace(part, material=dataclasses.replace(material, anisotropy=0.0))
        shading = channels.of_part(part)
    none = np.zeros((0, len(part.mesh.position)))
    table = None if shading.table is None else shading.table.lobes(shading.table.counts[0])
    gray = np.full(3, _GRAY)
    albedo = np.broadcast_to(np.asarray(shading.albedo, float), 3) if shading.matte else gray
    if table is None and not shading.matte:
        shading = dataclasses.replace(shading, blend=None)
    return part, shading, UnshadowedLobes(None, none, none, table, albedo, size)


def _bare(part: Part) -> Part:
    """The part with the base of its material."""
    return dataclasses.replace(part, material=channels.without_layers(channels.textured(part)))


def _base_shading(shading: Shading) -> Shading:
    """The base of a part under a layer."""
    table, blend, exact = standard.METALLIC_ROUGHNESS, shading.weighted, shading.exact
    over = exact.model if isinstance(exact, PerVertex) else exact
    base = require.kind("the BRDF under a layer", over, ClearCoat, Sheen, source="a TexturedMaterial").base
    weight = jnp.asarray(blend.weight[:, :BASE] + blend.weight[:, BASE : 2 * BASE])
    return dataclasses.replace(
        shading,
        brdf=table.family,
        exact=PerVertex(base),
        knot=table.knots,
        blend=Blend(weight, blend.parameter[:1]),
        term=table.term,
        scale=table.scale,
        table=table,
    )


class WidenedFamily(eqx.Module):
    """A family of BRDFs that reflect the middle of a texel as they reflect its square on average.

    Directions in a square of solid angle w have a variance of w / 12 along each axis, and their half vectors a fourth
    of it. A lobe of width a, whose slopes have a variance of a^2 / 2, becomes one of a^2 + w / 24.

    Attributes:
        family: The family, of the logarithm of a roughness.
        power: Power of the roughness that is a^2.
        solid_angle: Mean solid angle of a texel.
    """

    family: Callable
    power: int = eqx.field(static=True)
    solid_angle: float = eqx.field(static=True)

    def __call__(self, log_roughness: Float[Array, ""]) -> Callable:
        """The BRDF for the logarithm of a roughness."""
        square = jnp.exp(self.power * log_roughness) + self.solid_angle / 24
        return self.family(jnp.log(square) / self.power)


def _with_texels(system: System, seen: Any, part: Exported, shading: Shading) -> BrightTexels:
    """A system that sums the brightest texels of the light one by one, each at its center."""
    brdf = part.texel_brdf(shading.brdf) if shading.blend is None else shading.brdf
    if shading.table is not None:
        power = 4 if shading.table == standard.METALLIC_ROUGHNESS else 2
        brdf = WidenedFamily(brdf, power, 4 * np.pi / (6 * seen.size**2))
    return BrightTexels(system, seen, brdf, count=texels_of(seen.size), samples=None)


def texels_of(size: int) -> int:
    """Number of texels of a light that are summed one by one."""
    return min(_TEXELS, 6 * size**2 - 1)


def unit_of(values: Sequence[np.ndarray]) -> Float[np.ndarray, " k"]:
    """Quantization step of the signed bytes for each row, which all parts share."""
    largest = np.zeros(max(map(len, values)))
    for rows in values:
        now = np.abs(rows).max(tuple(range(1, rows.ndim)), initial=0)
        largest[: len(rows)] = np.maximum(largest[: len(rows)], now)
    return np.maximum(largest, 1e-12) / 127


def _shines(material: Any) -> bool:
    """Whether a material reflects more light by highlights than diffusely."""
    if not hasattr(material, "metallic"):
        diffuse, specular = (np.max(np.asarray(getattr(material, name, 0.0))) for name in ("diffuse", "specular"))
        return bool(diffuse < specular)
    texture = getattr(material, "metallic_texture", None)
    share = 1.0 if texture is None else np.mean(np.asarray(texture.image))
    return bool(np.mean(np.asarray(material.metallic)) * share > _METAL)


def _rounded(values: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Values that are multiples of their steps, as systems hold them."""
    unit = unit_of(values)
    rounded = []
    for rows in values:
        step = unit[: len(rows)].reshape(-1, *[1] * (rows.ndim - 1))
        rounded.append(np.round(rows / step) * step)
    return [np.asarray(rows.astype(jnp.result_type(float)), np.float64) for rows in rounded]
