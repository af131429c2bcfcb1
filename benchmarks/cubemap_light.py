"""Light of jaxprt as an emitter of Mitsuba 3: constant over each texel of its cubemap, drawn by its radiance.

Mitsuba's own environment map is bilinear over latitude and longitude. Where a material is about as sharp as a texel,
the two lights make different pictures.
"""

from typing import Any

import numpy as np

from benchmarks import plugins
from jaxprt.scene import Environment
from jaxprt.sphere import cubemap

_LUMINANCE = (0.2126, 0.7152, 0.0722)
_SPREAD = 1e-3  # share of the samples that are uniform over texels, so that none with light is left out by rounding


def emitter(light: Environment, *, reach: float) -> Any:
    """Mitsuba's emitter for a light; a variant must be set.

    Args:
        light: One environment.
        reach: How long shadow rays are: at least the diagonal of the scene.

    Raises:
        ValueError: A batch of lights.
    """
    if light.radiance.ndim != 4:
        raise ValueError(f"light must be one environment, got a batch {list(light.radiance.shape[:-4])}")
    return _class()(np.asarray(light.radiance, np.float32), reach)


@plugins.per_variant
def _class() -> Any:
    drjit, mitsuba = plugins.modules()
    axes = cubemap.axes()

    class CubemapLight(mitsuba.Emitter):
        def __init__(self, radiance, reach):
            super().__init__(mitsuba.Properties())
            self.m_flags = +mitsuba.EmitterFlags.Infinite
            edge = radiance.shape[1]
            power = (radiance @ _LUMINANCE * np.asarray(cubemap.solid_angle(size=edge))).reshape(6 * edge, edge)
            chance = power / max(power.sum(), 1e-30) * (1 - _SPREAD) + _SPREAD / power.size
            self.edge, self.distribution = edge, mitsuba.DiscreteDistribution2D(chance.astype(np.float32))
            # One lookup has the radiance and the density on the face, whose edge is 2.
            density = chance[..., None] / chance.sum() * (edge / 2) ** 2
            table = np.concatenate([radiance.reshape(6 * edge, edge, 3), density], -1).astype(np.float32)
            options = {"filter_mode": drjit.FilterMode.Nearest, "wrap_mode": drjit.WrapMode.Clamp}
            self.table = mitsuba.Texture2f(mitsuba.TensorXf(table), use_accel=False, **options)
            self.reach = mitsuba.Float(reach)
            drjit.make_opaque(self.reach)

        def look(self, direction):
            """Radiance and density by solid angle in a direction."""
            face, s, t, cubed = _project(direction)
            place = mitsuba.Point2f((s + 1) / 2, (face + drjit.clip((t + 1) / 2, 1e-6, 1 - 1e-6)) / 6)
            r, g, b, density = self.table.eval(place)
            return mitsuba.Color3f(r, g, b), density * cubed

        def eval(self, si, active=True):
            return drjit.select(active, self.look(-si.wi)[0], 0)

        def sample_direction(self, it, sample, active=True):
            place, _, rest = self.distribution.sample(sample)
            face = place.y // self.edge
            row = place.y - face * self.edge
            s, t = ((2 * (at + part)) / self.edge - 1 for at, part in ((place.x, rest.x), (row, rest.y)))
            direction = drjit.normalize(_direction(face, s, t))
            radiance, pdf = self.look(direction)
            result = mitsuba.DirectionSample3f()
            result.p, result.n, result.d = it.p + self.reach * direction, -direction, direction
            result.dist, result.pdf, result.time, result.delta, result.uv = self.reach, pdf, it.time, False, rest
            return result, drjit.select(active & (pdf > 0), radiance / drjit.maximum(pdf, 1e-30), 0)

        def pdf_direction(self, it, ds, active=True):
            return drjit.select(active, self.look(ds.d)[1], 0)

        def eval_direction(self, it, ds, active=True):
            return drjit.select(active, self.look(ds.d)[0], 0)

        def to_string(self):
            return f"CubemapLight[{self.edge}]"

    def _direction(face, s, t):
        """The point of a face, whose axes are those of `jaxprt.sphere.cubemap`."""
        result = mitsuba.Vector3f(0)
        for number, (along_s, along_t, outward) in enumerate(axes):
            point = [
                mitsuba.Float(a) * s + mitsuba.Float(b) * t + mitsuba.Float(c)
                for a, b, c in zip(along_s, along_t, outward, strict=True)
            ]
            result = drjit.select(face == number, mitsuba.Vector3f(*point), result)
        return result

    def _project(direction):
        """Face, s and t, and the cube of the distance of that point of the face."""
        best, face, s, t = -2.0, 0.0, 0.0, 0.0
        for number, (along_s, along_t, outward) in enumerate(axes):
            height, right, down = (
                sum(float(a) * each for a, each in zip(axis, direction, strict=True))
                for axis in (outward, along_s, along_t)
            )
            here = height > best
            face, best = drjit.select(here, float(number), face), drjit.select(here, height, best)
            s, t = drjit.select(here, right, s), drjit.select(here, down, t)
        s, t = s / best, t / best
        return face, s, t, drjit.power(1 + s**2 + t**2, 1.5)

    return CubemapLight
