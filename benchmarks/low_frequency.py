"""How exact is irradiance by harmonics, and what do products of harmonics cost?

    python -m benchmarks.low_frequency [--quick] [--output FILE]

Irradiance against sums over all texels of the light, and products against sums over integrals of three basis functions.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from jaxprt import scene
from jaxprt.scene import Environment, builtin, load_environment
from jaxprt.sphere import cubemap, harmonics, low_frequency

LIGHTS = {"grace": "grace_cross.hdr", "eucalyptus": "eucalyptus_rnl_cross.hdr", "sunrise": "polyhaven_sunrise_1k.exr"}


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    arguments = parser.parse_args(options)
    for line in (*irradiances(arguments.quick), multiplication(arguments.quick)):
        harness.report(line, arguments.output)


def lights(quick: bool) -> dict[str, Environment]:
    """Real ones, or the built-in sky."""
    folder = harness.data() / "env"
    if quick or not folder.exists():
        return {"daylight": builtin.daylight(size=16)}
    return {name: load_environment(folder / file) for name, file in LIGHTS.items()}


def irradiances(quick: bool) -> list[dict]:
    """Irradiance by harmonics, environment given, at some thousand normals, against the sum over texels."""
    normal = np.random.default_rng(2).normal(size=(100 if quick else 2000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    lines = []
    for name, light in lights(quick).items():
        size = light.radiance.shape[1]
        way = np.asarray(cubemap.direction(size=size), np.float64).reshape(-1, 3)
        flux = np.asarray(cubemap.solid_angle(size=size), np.float64).reshape(-1, 1) * np.asarray(
            light.radiance, np.float64
        ).reshape(-1, light.radiance.shape[-1])
        true = np.maximum(normal @ way.T, 0) @ flux
        for degree in (2,) if quick else (2, 4, 8, 16):
            call = lambda e=light, d=degree: scene.irradiance(e, normal, degree=d)  # noqa: E731
            lines.append(
                {
                    "benchmark": "low_frequency",
                    "case": f"irradiance, degree {degree}, {name}, {len(normal)} normals",
                    **harness.measure(call, repeats=5).line(),
                    "error": float(np.linalg.norm(np.asarray(call()) - true) / np.linalg.norm(true)),
                    "bytes": 4 * 3 * (degree + 1) ** 2,
                }
            )
    return lines


def multiplication(quick: bool, degree: int = 4) -> dict:
    """Products of many pairs of functions against the sums over integrals of three basis functions."""
    pairs, terms = (100 if quick else 100_000), (degree + 1) ** 2
    random = np.random.default_rng(3)
    first, second = (jnp.asarray(random.normal(size=(terms, pairs)), jnp.float32) for _ in range(2))
    node, weight = harmonics.quadrature(3 * degree)
    basis = harmonics.basis(np, node, degree)
    gamma = np.einsum("iq,jq,kq,q->ijk", basis, basis, basis, weight)
    nonzero = np.argwhere(np.abs(gamma) > 1e-12)
    order = nonzero[np.argsort(nonzero[:, 2], kind="stable")]
    value = jnp.asarray(gamma[tuple(order.T)], jnp.float32)
    own = jax.jit(lambda a, b: low_frequency.product(a, b, degree=degree))
    sparse = jax.jit(
        lambda a, b: jax.ops.segment_sum(
            value[:, None] * a[order[:, 0]] * b[order[:, 1]], order[:, 2], terms, indices_are_sorted=True
        )
    )
    mine, theirs = harness.compare(lambda: own(first, second), lambda: sparse(first, second), repeats=3)
    wide = (np.asarray(each, np.float64) for each in (first, second))
    true = np.einsum("kq,qv->kv", basis * weight, np.prod([basis.T @ each for each in wide], 0))

    def error(made) -> float:
        return float(np.linalg.norm(np.asarray(made) - true) / np.linalg.norm(true))

    return {
        "benchmark": "low_frequency",
        "case": f"product, degree {degree}, {pairs} pairs, {len(order)} integrals that are not 0",
        **mine.line(),
        "error": error(own(first, second)),
        "bytes": 3 * first.nbytes,
        "peer": "sparse sums",
        **theirs.peer(),
        "peer_error": error(sparse(first, second)),
    }


if __name__ == "__main__":
    main()
