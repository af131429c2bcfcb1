"""Direct light of one view by Mitsuba 3: converged pictures, and what few samples give, bare and denoised by Intel.

The scene has the same triangles, normals and materials as ours (`benchmarks.plugins`) in the same light, constant over
each texel (`benchmarks.cubemap_light`). Pixels are means over their squares. A path takes one sample of the light and
one of the material, weighed against each other. `available` of `benchmarks.path_tracing` says whether drjit finds LLVM;
without, Mitsuba runs in its variant scalar_rgb, hundreds of times slower since the plugins are Python.

The denoiser is Intel's Open Image Denoise by the package pyoidn. It gets the albedo and the normal of what is seen
first, which a few samples tell well enough for the edges; `clean` has it take them as free of noise.
"""

import math
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import cubemap_light, harness, path_tracing, plugins
from jaxprt import image
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.visibility import blocks

BLOCK = 1024  # samples of the converged picture at once
_FEATURES = 4  # samples of albedo and normal: more improve no picture by more than 2 % of its error
_COVERED = 0.999  # rays through edges of triangles may miss both
_CONVERGENCE = 0.5  # of Monte Carlo: error falls as this power of time


class View:
    """A scene that Mitsuba sees from one camera.

    Attributes:
        variant: Mitsuba's variant.
        bytes: Of the triangles and the light.
        key: Fingerprint of all that is seen.
    """

    def __init__(self, parts: Sequence[tuple[Mesh, Any]], light: Environment, camera: Camera):
        """Loads the scene.

        Args:
            parts: Meshes, each with its material: one that `plugins.bsdf` has.
            light: One environment, hidden from the camera.
            camera: From where.
        """
        import mitsuba

        self.variant = "llvm_ad_rgb" if path_tracing.available() else "scalar_rgb"
        mitsuba.set_variant(self.variant)
        self._mitsuba = mitsuba
        corner = np.concatenate([np.asarray(mesh.position) for mesh, _ in parts])
        sensor = path_tracing.sensor(mitsuba, camera)
        sensor["film"]["pixel_format"] = "rgba"
        self._scene = mitsuba.load_dict(
            {
                "type": "scene",
                "sensor": sensor,
                "light": cubemap_light.emitter(light, reach=2 * float(np.linalg.norm(np.ptp(corner, 0)))),
                **{
                    f"part{number}": path_tracing.shape(
                        mitsuba, mesh, plugins.bsdf(material), plugins.attributes(material)
                    )
                    for number, (mesh, material) in enumerate(parts)
                },
            }
        )
        self._direct = mitsuba.load_dict({"type": "direct", "hide_emitters": True})
        self._first = mitsuba.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        arrays = [x for mesh, _ in parts for x in (mesh.position, mesh.normal, mesh.face)] + [light.radiance]
        self.bytes = sum(x.nbytes for x in arrays)
        kinds = [np.frombuffer(type(material).__name__.encode(), np.uint8) for _, material in parts]
        leaves = jax.tree.leaves(([material for _, material in parts], camera))
        self.key = blocks.fingerprint(*arrays, *kinds, *leaves, (camera.height, camera.width))

    def radiance(self, samples: int, seed: int) -> np.ndarray:
        """Linear radiance and the share that surfaces cover, [h w 4]; seeds give independent noise."""
        return self._render(self._direct, samples, seed)

    def features(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Albedo and shading normal of the first surface, [h w 3] each; zero where there is none."""
        found = self._render(self._first, _FEATURES, seed)
        return np.ascontiguousarray(found[..., -6:-3]), np.ascontiguousarray(found[..., -3:])

    def _render(self, integrator: Any, samples: int, seed: int) -> np.ndarray:
        number = self._mitsuba.UInt32(seed)
        return np.array(self._mitsuba.render(self._scene, integrator=integrator, spp=samples, seed=number))


def denoise(
    radiance: np.ndarray, albedo: np.ndarray, normal: np.ndarray, *, clean: bool, quality: str = "high"
) -> np.ndarray:
    """A picture [h w 3] without most of its noise.

    Args:
        radiance: Linear radiance [h w 3 or more]; the first three colors are taken.
        albedo: Of the first surface.
        normal: Of the first surface.
        clean: Whether albedo and normal count as free of noise, which takes a larger network.
        quality: "high", "balanced" or "fast".
    """
    import pyoidn

    color = np.ascontiguousarray(radiance[..., :3])
    return pyoidn.denoise(color, np.clip(albedo, 0, 1), normal, hdr=True, clean_aux=clean, quality=quality)


class Truth:
    """A converged picture as two halves with independent noise, and what pictures are off from it.

    Pixels that surfaces fill are compared, or all that they touch; the background is left out.

    Attributes:
        mean: Linear radiance [h w 3], zero where pixels are not compared.
        inside: The pixels that are compared.
        noise: Relative L2 that is left in `mean`.
        samples: Of both halves.
    """

    def __init__(self, halves: np.ndarray, samples: int, *, covered: float = _COVERED):
        """Takes the halves [2 h w 4] of so many samples, at pixels of which surfaces cover more than a share."""
        self.inside = np.all(halves[..., 3] > covered, 0)
        if not self.inside.any():
            raise ValueError("the camera must see surfaces that fill pixels, got none")
        self.samples = samples
        self.mean = np.where(self.inside[..., None], halves[..., :3].mean(0), 0).astype(np.float32)
        self._one, self._other = (each[self.inside][:, :3].astype(np.float64) for each in halves)
        self._size = float(np.linalg.norm(self.mean[self.inside].astype(np.float64)))
        self.noise = float(np.linalg.norm(self._one - self._other) / 2 / self._size)

    def error(self, picture: np.ndarray) -> float:
        """Relative L2 of a picture [h w 3 or more], without the noise of the halves: it falls out of their product."""
        mine = np.asarray(picture, np.float64)[self.inside][:, :3]
        return float(max(np.sum((mine - self._one) * (mine - self._other)), 0) ** 0.5 / self._size)

    def bias(self, picture: np.ndarray) -> float:
        """How much brighter the whole is."""
        return float(np.sum(np.asarray(picture, np.float64)[self.inside][:, :3]) / np.sum(self.mean, dtype=float) - 1)

    def flip(self, picture: np.ndarray) -> float:
        """FLIP over the whole picture with a black background, of linear radiance."""
        mine = np.where(self.inside[..., None], np.asarray(picture)[..., :3], 0)
        return image.flip(jnp.asarray(mine, jnp.float32), jnp.asarray(self.mean))


def converged(view: View, *, noise: float, most: int, block: int = BLOCK, path: pathlib.Path | None = None) -> Truth:
    """The picture of a view by so many samples that its noise is small.

    Args:
        view: The view.
        noise: Relative L2 at which to stop.
        most: Samples at which to stop anyway.
        block: Samples at once.
        path: A file that keeps what is traced. A later call goes on from there, unless it is of another view.

    Returns:
        The picture; its `noise` may be larger than asked for.
    """
    halves, each = _kept(view, path)
    while not each or (Truth(halves, 2 * each).noise > noise and 2 * (each + block) <= most):
        seeds = np.random.SeedSequence([each, block]).generate_state(2)  # unlike those of few samples
        more = np.stack([view.radiance(block, int(seed)) for seed in seeds]).astype(np.float64)
        halves, each = (each * halves + block * more) / (each + block), each + block
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, halves=halves.astype(np.float32), each=each, key=view.key)
    return Truth(halves, 2 * each)


def _kept(view: View, path: pathlib.Path | None) -> tuple[np.ndarray, int]:
    """Halves that a file has of a view, and the samples of each; none if there is no such file."""
    if path is not None and path.is_file():
        with np.load(path) as kept:
            if str(kept["key"]) == view.key:
                return kept["halves"].astype(np.float64), int(kept["each"])
    return np.zeros(()), 0


class Point(NamedTuple):
    """What some samples give.

    Attributes:
        method: "mitsuba", or "mitsuba, denoised", or with ", clean" behind.
        samples: Per pixel.
        timing: Of all that leads to the picture.
        picture: Linear radiance [h w 3 or more].
        error: Relative L2.
    """

    method: str
    samples: int
    timing: harness.Timing
    picture: np.ndarray
    error: float


def points(view: View, truth: Truth, samples: Sequence[int], *, seed: int = 1) -> list[Point]:
    """Pictures of few samples with their times, bare and denoised with and without `clean`."""
    first = harness.measure(lambda: view.features(seed), repeats=3)
    albedo, normal = view.features(seed)
    result = []
    for count in samples:
        traced = harness.measure(lambda count=count: view.radiance(count, seed), repeats=3 if count < 64 else 1)
        bare = view.radiance(count, seed)
        result.append(Point("mitsuba", count, traced, bare, truth.error(bare)))
        for method, clean in (("mitsuba, denoised", False), ("mitsuba, denoised, clean", True)):
            timing = harness.measure(
                lambda clean=clean, bare=bare: denoise(bare, albedo, normal, clean=clean), repeats=3
            )
            smooth = denoise(bare, albedo, normal, clean=clean)
            steps = (traced, first, timing)
            seconds, compiling = (sum(each[n] for each in steps) for n in (0, 1))
            whole = harness.Timing(seconds, compiling, traced.repeats)
            result.append(Point(method, count, whole, smooth, truth.error(smooth)))
    return result


def front(found: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The pairs of seconds and error to which no other pair is superior, by seconds."""
    best: list[tuple[float, float]] = []
    for seconds, error in sorted(found):
        if not best or error < best[-1][1]:
            best.append((seconds, error))
    return best


def seconds_at(error: float, found: Sequence[tuple[float, float]]) -> tuple[float, str]:
    """When a method reaches an error, on a curve that is straight between its points in logarithms.

    Args:
        error: The error; it must be positive.
        found: Pairs of seconds and error of the method.

    Returns:
        The seconds, and how they were found: "interpolated"; "extrapolated" with the slope of the last two points, or
        as Monte Carlo converges from a single one; or "cheapest", where even the fastest picture is no worse.
    """
    best = front(found)
    if error >= best[0][1]:
        return best[0][0], "cheapest"
    log = np.log(best)
    after = next((n for n, each in enumerate(best) if each[1] <= error), None)
    if after is None and len(best) == 1:
        return best[0][0] * (best[0][1] / error) ** (1 / _CONVERGENCE), "extrapolated"
    last = len(best) - 1 if after is None else after
    (t0, e0), (t1, e1) = log[last - 1], log[last]
    seconds = math.exp(t0 + (t1 - t0) * (math.log(error) - e0) / (e1 - e0))
    return seconds, "extrapolated" if after is None else "interpolated"
