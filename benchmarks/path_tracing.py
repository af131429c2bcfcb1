"""What a path tracer makes of the same view: Mitsuba 3's error and time by samples per pixel, and pictures to judge by.

`measure` is for the front's plot: the same meshes under the same light from the same place, direct light alone; the
object is half diffuse, half a rough conductor as wide as Ashikhmin-Shirley (10, 100), for which Mitsuba has no plugin.
A picture's error is its noise, which a picture of another seed does not share: their difference is sqrt(2) of it, so
no converged one is needed.

`picture` and `trace` follow paths through scenes with jaxprt's own materials. They compile for the processor with
LLVM, which must be installed; `available` tells. `trace` does without, slowly.
"""

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import plugins
from jaxprt.brdf import AshikhminShirley, BlinnPhong, CookTorrance, Lambert
from jaxprt.image import raster
from jaxprt.scene import Camera, Environment, Mesh, environment

EDGE = 256  # pixels: about as many as there are vertices
SAMPLES = (4, 16, 64, 256, 1024)
_LLVM = 17  # the first that has minima of floats on x86: the process ends where an older one meets them
_PATHS = 1 << 22  # traced at once: some 200 bytes each
_ROUGHNESS = {"alpha_u": (2 / 12) ** 0.5, "alpha_v": (2 / 102) ** 0.5}  # of Blinn's distribution with these exponents


class Exact(NamedTuple):
    """Mitsuba's picture as two of independent noise, so that noise does not count as error.

    Attributes:
        first: One half of the samples.
        second: The other half.
    """

    first: np.ndarray
    second: np.ndarray

    @property
    def picture(self) -> np.ndarray:
        """The mean of both."""
        return (self.first + self.second) / 2

    def off(self, mine: np.ndarray, where: np.ndarray | None = None) -> float:
        """Relative L2 of a picture over some pixels that the scene fills, all if None, without the noise of the halves.

        The mean product of the differences from two pictures of independent noise is the square of the difference from
        their expectation.
        """
        inside = (mine[..., 3] == 1) & (self.first[..., 3] == 1)
        inside = inside if where is None else inside & where
        one, other, ours = (picture[inside][:, :3].astype(np.float64) for picture in (self.first, self.second, mine))
        square, whole = np.sum((ours - one) * (ours - other)), np.sum(one * other)
        return float(np.sqrt(max(square, 0.0) / whole))


def measure(glossy: Mesh, ground: Mesh, lights: dict[str, Environment], eye: np.ndarray, *, quick: bool):
    """One line for each light and number of samples, as `benchmarks.compression` has them."""
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    mirror = {"type": "roughconductor", "material": "none", "distribution": "beckmann", **_ROUGHNESS}
    shapes = {
        "glossy": shape(mitsuba, glossy, {"type": "blendbsdf", "weight": 0.5, "matte": matte, "mirror": mirror}),
        "ground": shape(mitsuba, ground, matte),
    }
    edge = 32 if quick else EDGE
    view = mitsuba.ScalarTransform4f().look_at(
        origin=np.asarray(eye, float).tolist(), target=np.mean(glossy.position, 0, float).tolist(), up=[0, 1, 0]
    )
    film = {"type": "hdrfilm", "width": edge, "height": edge, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    for name, light in lights.items():
        picture = latlong(light)
        scene = mitsuba.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": 2, "hide_emitters": True},
                "sensor": {"type": "perspective", "fov": 35, "to_world": view, "film": film},
                "light": {"type": "envmap", "bitmap": mitsuba.Bitmap(picture)},
                **shapes,
            }
        )
        for samples in SAMPLES[:2] if quick else SAMPLES:
            start = time.perf_counter()
            one, other = (np.array(mitsuba.render(scene, spp=samples, seed=mitsuba.UInt32(each))) for each in (1, 2))
            seconds = (time.perf_counter() - start) / 2
            noise = np.linalg.norm(one - other) / np.sqrt(2)
            yield {
                **{"benchmark": "compression", "case": f"Mitsuba 3, {samples} samples, {name}", "light": name},
                **{"seconds": seconds, "compile_seconds": 0.0, "view_seconds": seconds, "method": "Mitsuba 3"},
                "error": float(noise / np.linalg.norm((one + other) / 2)),
                "bytes": picture.nbytes + sum(x.nbytes for m in (glossy, ground) for x in (m.position, m.face)),
            }


def available() -> bool:
    """Whether `picture` can run: it needs Mitsuba, and LLVM 17 or newer, which DRJIT_LIBLLVM_PATH may name."""
    try:
        import drjit
    except ImportError:
        return False

    return bool(drjit.has_backend(drjit.JitBackend.LLVM)) and drjit.detail.llvm_version()[0] >= _LLVM


def picture(
    mesh: Mesh,
    materials: Sequence[CookTorrance | AshikhminShirley | BlinnPhong | Lambert],
    light: Environment,
    camera: Camera,
    *,
    depth: int,
    samples: int,
    seed: int = 0,
) -> np.ndarray:
    """Radiance towards a camera, by path tracing in Mitsuba 3's variant llvm_ad_rgb, which is left as the current one.

    Needs LLVM 17 or newer, see `available`. Pixels are means over their squares. Other materials, lights, cameras and
    seeds do not compile anew.

    Args:
        mesh: The scene, which shadows and lights itself; a face is of its first corner's region.
        materials: The material of each region, black on the back.
        light: One environment, hidden from the camera.
        camera: From where; the rays are those of `jaxprt.image`.
        depth: How many segments a path from the eye to the light has at most: 2 is direct light, 3 one bounce.
        samples: Paths per pixel, jittered in a grid: best a square, and for large pictures a multiple of 64.
        seed: Pictures of two seeds have independent noise.

    Returns:
        Linear radiance [h, w, 3], zero where nothing is seen.

    Raises:
        ValueError: A region without a material or a material of another kind, a batch of lights, no sample, or a
            depth below 2.
        RuntimeError: There is no LLVM of at least version 17.
    """
    region = np.asarray(mesh.region)[np.asarray(mesh.face)[:, 0]]
    used = np.unique(region)
    if used[-1] >= len(materials):
        raise ValueError(f"materials must have one for each region, got {len(materials)} and region {used[-1]}")
    if light.radiance.ndim != 4:
        raise ValueError(f"light must be one environment, got a batch {list(light.radiance.shape[:-4])}")
    if depth < 2 or samples < 1:
        raise ValueError(f"depth must be at least 2 and samples at least 1, got {depth} and {samples}")
    if not available():
        raise RuntimeError(f"picture needs LLVM {_LLVM} or newer; DRJIT_LIBLLVM_PATH may name its shared library")
    parts = [(_part(mesh, region == number), materials[number]) for number in used]
    return trace(parts, light, camera, depth=depth, samples=samples, seed=seed)


def trace(
    parts: Sequence[tuple[Mesh, Any]],
    light: Environment,
    camera: Camera,
    *,
    depth: int = 2,
    samples: int,
    seed: int = 0,
    sky: bool = False,
) -> np.ndarray:
    """Radiance of meshes with their materials, as `picture`; without LLVM slowly, in the variant scalar_rgb.

    Args:
        parts: Meshes, each with its material: one that `plugins.bsdf` has. A material of each vertex is interpolated.
        light: One environment.
        camera: From where.
        depth: As in `picture`.
        samples: As in `picture`.
        seed: As in `picture`.
        sky: Whether the light is seen behind the meshes.

    Returns:
        Linear radiance [h, w, 3].
    """
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb" if available() else "scalar_rgb")
    scene = mitsuba.load_dict(
        {
            "type": "scene",
            # Russian roulette would only add noise at depths that are looked at.
            "integrator": {"type": "path", "max_depth": depth, "rr_depth": 100, "hide_emitters": not sky},
            "sensor": sensor(mitsuba, camera),
            "light": {"type": "envmap", "bitmap": mitsuba.Bitmap(latlong(light))},
            **{
                f"part{number}": shape(mitsuba, mesh, plugins.bsdf(material), plugins.attributes(material))
                for number, (mesh, material) in enumerate(parts)
            },
        }
    )
    # Squares, as which the sampler jitters; other counts it rounds up, with a warning.
    most = max(1, math.isqrt(_PATHS // (camera.width * camera.height))) ** 2
    counts = [min(most, samples - first) for first in range(0, samples, most)]
    seeds = np.random.SeedSequence(seed).generate_state(len(counts))
    total = np.zeros((camera.height, camera.width, 3))
    for count, each in zip(counts, seeds, strict=True):
        total += count * np.array(mitsuba.render(scene, spp=count, seed=mitsuba.UInt32(int(each))))
    return (total / samples).astype(np.float32)


def sensor(mitsuba, camera: Camera) -> dict:
    """Mitsuba's camera of the same rays; it looks along +z with +x to the left."""
    eye, target = np.asarray(camera.eye, float), np.asarray(camera.target, float)
    _, up, forward = np.asarray(raster.view_axes(camera), float)
    view = mitsuba.ScalarTransform4f().look_at(origin=eye.tolist(), target=(eye + forward).tolist(), up=up.tolist())
    size = {"width": camera.width, "height": camera.height}
    distance = float(np.linalg.norm(target - eye))
    return {
        "type": "perspective",
        "fov": float(np.degrees(camera.field_of_view)),
        "fov_axis": "y",
        "near_clip": 1e-4 * distance,
        "far_clip": 1e4 * distance,
        "to_world": view,
        "sampler": {"type": "multijitter"},  # as fast as independent samples, with half their noise
        "film": {"type": "hdrfilm", **size, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
    }


def _part(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """Some faces of a mesh with their vertices."""
    face = np.asarray(mesh.face)[chosen]
    used, face = np.unique(face, return_inverse=True)
    position, normal, tangent, region = (
        jnp.asarray(np.asarray(field)[used]) for field in (mesh.position, mesh.normal, mesh.tangent, mesh.region)
    )
    return Mesh(position, jnp.asarray(face.reshape(-1, 3), jnp.int32), normal, tangent, region)


def shape(mitsuba, mesh: Mesh, bsdf, attributes: Mapping[str, np.ndarray] | None = None):
    """Mitsuba's mesh of a material, with tangents and other attributes [v c] of its vertices."""
    props = mitsuba.Properties()
    props["bsdf"] = mitsuba.load_dict(bsdf) if isinstance(bsdf, dict) else bsdf
    result = mitsuba.Mesh("mesh", len(mesh.position), len(mesh.face), has_vertex_normals=True, props=props)
    parameters = mitsuba.traverse(result)
    parameters["vertex_positions"] = np.asarray(mesh.position).ravel()
    parameters["vertex_normals"] = np.asarray(mesh.normal).ravel()
    parameters["faces"] = np.asarray(mesh.face).ravel()
    parameters.update()
    for name, value in {plugins.TANGENT: mesh.tangent, **(attributes or {})}.items():
        result.add_attribute(name, value.shape[1], np.asarray(value, np.float32).ravel())
    return result


def latlong(light: Environment) -> np.ndarray:
    """The light as Mitsuba reads it: the first and last rows are the poles, the center column is +z."""
    height = 4 * light.radiance.shape[-2]
    longitude = np.pi * (1 - 2 * (np.arange(2 * height) + 0.5) / (2 * height))
    latitude, longitude = np.meshgrid(np.linspace(np.pi / 2, -np.pi / 2, height), longitude, indexing="ij")
    across = np.cos(latitude)
    direction = np.stack([np.sin(longitude) * across, np.sin(latitude), np.cos(longitude) * across], -1)
    return np.array(environment.background(light, jnp.asarray(direction, jnp.float32)), order="C")
