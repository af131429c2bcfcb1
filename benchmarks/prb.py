"""Light and materials from pictures by Mitsuba 3's own differentiable path tracer (prb) and Adam: the peer of ours.

Both need LLVM 17 or newer, see `benchmarks.path_tracing.available`, and trace direct light alone.
"""

import time
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from benchmarks import path_tracing, plugins
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.sphere import cubemap, harmonics

_EDGE = 16  # of the cubemap that harmonics are drawn to


def fit_light(
    mesh: Mesh, albedo: float, image: np.ndarray, camera: Camera, *, degree: int, steps: int, samples: int, rate: float
) -> tuple[list[np.ndarray], float]:
    """Harmonics of the light of a picture of a diffuse object.

    Args:
        mesh: The object.
        albedo: Of all of it.
        image: The picture.
        camera: From where.
        degree: Of the harmonics.
        steps: Of Adam.
        samples: Paths per pixel and step.
        rate: Of Adam.

    Returns:
        Coefficients in three colors after each step, and the seconds of a step.
    """
    import drjit
    import mitsuba

    constant = Environment(jnp.ones((6, _EDGE, _EDGE, 3)))
    scene = _scene(mesh, Lambert(albedo), constant, [camera])
    names = mitsuba.traverse(scene)
    value = harmonics.evaluate(cubemap.direction(size=_EDGE), degree=degree)
    each = [path_tracing.latlong(Environment(value[..., [n] * 3]))[..., 0] for n in range((degree + 1) ** 2)]
    basis = np.stack(each, -1)
    basis = np.concatenate([basis, basis[:, :1]], 1)  # Mitsuba has the first column again behind the last.
    start = np.zeros((basis.shape[-1], 3))
    start[0] = np.sqrt(4 * np.pi) * image[image.any(-1)].mean(0) / albedo

    def slope(x, step):
        data = mitsuba.TensorXf((basis @ x).astype(np.float32))
        drjit.enable_grad(data)
        names["light.data"] = data
        names.update()
        _render(scene, names, [image], step, samples)
        return np.einsum("hwl,hwc->lc", basis, np.array(drjit.grad(data)))

    return _adam(slope, start, steps, rate)


def fit_material(
    mesh: Mesh,
    start: AshikhminShirley,
    light: Environment,
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    *,
    steps: int,
    samples: int,
    rate: float,
) -> tuple[list[dict[str, np.ndarray]], float]:
    """Ashikhmin and Shirley's parameters of an object in pictures under a known light.

    Logarithms are fitted, so that none turns negative.

    Args:
        mesh: The object.
        start: Material to start from.
        light: The light.
        images: The pictures.
        cameras: Of each.
        steps: Of Adam.
        samples: Paths per pixel and step.
        rate: Of Adam.

    Returns:
        Parameters after each step, and the seconds of a step.
    """
    import drjit
    import mitsuba

    scene = _scene(mesh, start, light, cameras)
    names = mitsuba.traverse(scene)
    sizes = {"diffuse": 3, "specular": 1, "nu": 1, "nv": 1}
    ends = np.cumsum(list(sizes.values()))[:-1]

    def parts(x):
        return dict(zip(sizes, np.split(np.exp(x), ends), strict=True))

    def slope(x, step):
        for name, value in parts(x).items():
            kind = mitsuba.Color3f if name in ("diffuse", "specular") else mitsuba.Float
            given = kind(np.broadcast_to(value, 3).tolist() if kind is mitsuba.Color3f else float(value[0]))
            drjit.enable_grad(given)
            names[f"object.bsdf.{name}"] = given
        names.update()
        _render(scene, names, images, step, samples)
        slopes = [np.array(drjit.grad(names[f"object.bsdf.{name}"])).ravel() for name in sizes]
        slopes = [each.sum(keepdims=True) if sizes[n] == 1 else each for n, each in zip(sizes, slopes, strict=True)]
        return np.concatenate(slopes) * np.exp(x)

    first = [np.broadcast_to(getattr(start, name), size).astype(float) for name, size in sizes.items()]
    path, seconds = _adam(slope, np.log(np.concatenate(first)), steps, rate)
    return [parts(x) for x in path], seconds


def _scene(mesh: Mesh, material, light: Environment, cameras: Sequence[Camera]):
    """Traced by prb; sensors by number."""
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    return mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 2, "rr_depth": 100, "hide_emitters": True},
            **{f"sensor{n}": path_tracing.sensor(mitsuba, each) for n, each in enumerate(cameras)},
            "light": {"type": "envmap", "bitmap": mitsuba.Bitmap(path_tracing.latlong(light))},
            "object": path_tracing.shape(mitsuba, mesh, plugins.bsdf(material)),
        }
    )


def _render(scene, names, images: Sequence[np.ndarray], step: int, samples: int) -> None:
    """Mean squares of differences from the pictures, and their gradients."""
    import drjit
    import mitsuba

    for number, image in enumerate(images):
        seed = 2 * (step * len(images) + number)
        made = mitsuba.render(scene, names, sensor=number, spp=samples, seed=seed, seed_grad=seed + 1)  # type: ignore
        drjit.backward(drjit.mean(drjit.square(made - mitsuba.TensorXf(image)), axis=None))


def _adam(slope: Callable, start: np.ndarray, steps: int, rate: float) -> tuple[list[np.ndarray], float]:
    """All steps, and the mean seconds of one but the first, which compiles."""
    value, first, second = start, np.zeros_like(start), np.zeros_like(start)
    path, seconds = [], []
    for step in range(1, steps + 1):
        begun = time.perf_counter()
        each = slope(value, step)
        first, second = 0.9 * first + 0.1 * each, 0.999 * second + 0.001 * each**2
        value = value - rate * (first / (1 - 0.9**step)) / (np.sqrt(second / (1 - 0.999**step)) + 1e-12)
        path.append(value)
        seconds.append(time.perf_counter() - begun)
    return path, float(np.mean(seconds[1:]))
