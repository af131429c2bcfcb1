"""How well lobes light each material: error by number of lobes and roughness, and what a frame and a fit cost.

    python -m benchmarks.lobes [--quick] [--output FILE]

Three hundred random vertices of the bunny on its ground (from JAXPRT_DATA; a sphere where that is not set, and with
--quick) from twenty views that they face, under each light, against the integral over all texels. Sixteen texels are
summed one by one, by as many points as the BRDF needs. `specular` is Cook-Torrance's model without a diffuse part, so
that nothing hides the error.
`seconds` is a frame in which light, view and BRDF are all new, on all the vertices taken. `unoccluded` is the error of
the table itself, without shadows; `terms_error` that of sixteen separable terms with exact visibility and all texels.
`remainder_errors`, of eight lobes, are what 4, 8 and 16 separable terms of the remainder leave, with exact visibility.
"""

import time
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import compression, harness
from benchmarks.published.lobes import Remainder
from jaxprt import bright_texels, lobe, reference, separable, visibility
from jaxprt.brdf import AshikhminShirley, CookTorrance
from jaxprt.scene import Environment
from jaxprt.scene.mesh import join
from jaxprt.sphere import directions

SUN = 16
TERMS_ERROR = np.inf  # Texel centers serve terms: their maps are smooth but for a bend at each texel.
MATERIALS = {
    **{
        f"specular m = {m}": CookTorrance(diffuse=0.0, specular=0.5, roughness=m, f0=0.3)
        for m in (0.05, 0.1, 0.2, 0.35, 0.5)
    },
    "Ashikhmin-Shirley (10, 100)": AshikhminShirley(),
}
COUNTS = (4, 8, 12, 16)
REMAINDER = (4, 8, 16)  # terms, beside eight lobes


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    for line in measure(arguments.quick):
        harness.report(line, arguments.output)


def measure(quick: bool):
    """Lines of all materials, numbers of lobes and lights."""
    glossy, ground, lights = compression.scene(quick)
    vertex = np.random.default_rng(0).permutation(len(glossy.position))[: 60 if quick else 300]
    size = lights[0].radiance.shape[-2]
    visible = visibility.precompute(
        join([glossy, ground]), size=size, vertex=np.sort(vertex), run=prt.Run(progress=False)
    )
    transport = lobe.compress(visible)
    seen = jnp.asarray(visible.seen(np.arange(len(vertex))))
    views = jnp.asarray(compression.eyes(glossy, 2 if quick else 20))
    names = compression.names(lights)
    batch = Environment(jnp.stack([light.radiance for light in lights]))
    for material, brdf in list(MATERIALS.items())[2:3] if quick else MATERIALS.items():
        exact = radiance(brdf, seen, visible, batch, views)
        samples = bright_texels.samples_for(brdf)
        factored = separable.factor(brdf, terms=16, resolution=12 if quick else 64)
        peer = radiance(factored, seen, visible, batch, views, error=TERMS_ERROR)
        for count in (1,) if quick else COUNTS:
            start = time.perf_counter()
            table = lobe.tabulate(brdf, lobes=count, resolution=12 if quick else 32)
            fitted = time.perf_counter() - start
            more = []
            if quick or count == 8:
                terms = (2,) if quick else REMAINDER
                rest = Environment(jnp.stack([bright_texels.split(light, count=SUN)[2].radiance for light in lights]))
                left = Remainder(brdf, table)
                most = separable.factor(left, terms=max(terms), resolution=12 if quick else 64)
                more = [
                    radiance(most.truncate(number), seen, visible, rest, views, error=TERMS_ERROR) for number in terms
                ]
            for number, (name, light) in enumerate(zip(names, lights, strict=True)):

                def frame(eye=views[0], table=table, light=light, brdf=brdf, samples=samples):
                    texel, excess, rest = bright_texels.split(light, count=SUN)
                    color = prt.radiance(lobe.LobeSystem(transport, table), rest, eye=eye)
                    return color + bright_texels.radiance(transport, brdf, texel, excess, eye=eye, samples=samples)

                color = np.stack([frame(eye) for eye in views])
                known = np.stack([height(visible, eye) > 0 for eye in views])
                wrong, other = (error(x, exact[number], known) for x in (color, peer[number]))
                yield {
                    **{"benchmark": "lobes", "case": f"{material}, {count} lobes, {name}"},
                    **harness.measure(frame, repeats=3 if quick else 7).line(),
                    **{"error": wrong, "bytes": transport.nbytes, "unoccluded": float(table.error)},
                    **{"fit_seconds": fitted, "table_bytes": table.nbytes},
                    **{"terms_error": other},
                    **(
                        {"remainder_errors": [error(color + each[number], exact[number], known) for each in more]}
                        if more
                        else {}
                    ),
                }


def radiance(brdf, seen, visible, batch, views, *, error: float = 1e-3) -> np.ndarray:
    """Radiance [light, view, vertex, color] by integration over all texels."""
    each = [reference.integrate(seen, visible.position, visible.frame, brdf, batch, eye, error=error) for eye in views]
    return np.stack(each, 1)


def height(visible, eye) -> np.ndarray:
    """Cosine of each vertex's view."""
    wo = directions.normalize(eye - visible.position)
    return np.asarray(jnp.sum(wo * visible.frame[:, 2], -1))


def error(value: np.ndarray, exact: np.ndarray, known: np.ndarray) -> float:
    """Relative L2 error where it is known."""
    return float(np.linalg.norm((value - exact)[known]) / np.linalg.norm(exact[known]))


if __name__ == "__main__":
    main()
