"""What a path tracer makes of the same view: Mitsuba 3's error and time by samples per pixel, for the front's plot.

The same meshes under the same light from the same place, direct light alone; the object is half diffuse, half a rough
conductor as wide as Ashikhmin-Shirley (10, 100), for which Mitsuba has no plugin. A picture's error is its noise, which
a picture of another seed does not share: their difference is sqrt(2) of it, so no converged one is needed.
"""

import time

import jax.numpy as jnp
import numpy as np

from jaxprt.scene import Environment, Mesh, environment

EDGE = 256  # pixels: about as many as there are vertices
SAMPLES = (4, 16, 64, 256, 1024)
_ROUGHNESS = {"alpha_u": (2 / 12) ** 0.5, "alpha_v": (2 / 102) ** 0.5}  # of Blinn's distribution with these exponents


def measure(glossy: Mesh, ground: Mesh, lights: dict[str, Environment], eye: np.ndarray, *, quick: bool):
    """One line for each light and number of samples, as `benchmarks.compression` has them."""
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    mirror = {"type": "roughconductor", "material": "none", "distribution": "beckmann", **_ROUGHNESS}
    shapes = {
        "glossy": _shape(mitsuba, glossy, {"type": "blendbsdf", "weight": 0.5, "matte": matte, "mirror": mirror}),
        "ground": _shape(mitsuba, ground, matte),
    }
    edge = 32 if quick else EDGE
    view = mitsuba.ScalarTransform4f().look_at(
        origin=np.asarray(eye, float).tolist(), target=np.mean(glossy.position, 0, float).tolist(), up=[0, 1, 0]
    )
    film = {"type": "hdrfilm", "width": edge, "height": edge, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    for name, light in lights.items():
        picture = _latlong(light)
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


def _shape(mitsuba, mesh: Mesh, bsdf: dict):
    props = mitsuba.Properties()
    props["bsdf"] = mitsuba.load_dict(bsdf)
    shape = mitsuba.Mesh("mesh", len(mesh.position), len(mesh.face), has_vertex_normals=True, props=props)
    parameters = mitsuba.traverse(shape)
    parameters["vertex_positions"] = np.asarray(mesh.position).ravel()
    parameters["vertex_normals"] = np.asarray(mesh.normal).ravel()
    parameters["faces"] = np.asarray(mesh.face).ravel()
    parameters.update()
    return shape


def _latlong(light: Environment) -> np.ndarray:
    """The light as Mitsuba reads it: the first and last rows are the poles, the center column is +z."""
    height = 4 * light.radiance.shape[-2]
    longitude = np.pi * (1 - 2 * (np.arange(2 * height) + 0.5) / (2 * height))
    latitude, longitude = np.meshgrid(np.linspace(np.pi / 2, -np.pi / 2, height), longitude, indexing="ij")
    across = np.cos(latitude)
    direction = np.stack([np.sin(longitude) * across, np.sin(latitude), np.cos(longitude) * across], -1)
    return np.array(environment.background(light, jnp.asarray(direction, jnp.float32)), order="C")
