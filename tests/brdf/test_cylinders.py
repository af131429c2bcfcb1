"""Both surfaces against rays that are traced through their profiles, and against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import BlinnPhong, PoulinFournier, PoulinFournierGrooves
from tests.upper import evaluate

SAMPLES = 20000  # along each part of a profile
TRACED_TOLERANCE = 1e-3  # Of the traced integral: it counts samples, and some are at the limits of what is seen.


def _pairs(count, seed=0):
    """Directions all over the hemisphere, many grazing, many pairs with a highlight of some point of the cylinders."""
    random = np.random.default_rng(seed)
    direction = random.standard_normal((2, count, 3))
    direction[..., 2] = np.abs(direction[..., 2]) * random.choice([1, 0.2], (2, count))
    direction[1, : count // 2, 0] = -direction[0, : count // 2, 0]
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _raised_profile(distance, height):
    """Points, normals and lengths of one period: what lies in no other cylinder, and above or on the plane."""
    angle = (np.arange(SAMPLES) + 0.5) / SAMPLES * 2 * np.pi - np.pi
    arc = np.stack([np.sin(angle), np.cos(angle)], -1)
    outside = np.all([np.hypot(arc[:, 0] - k * distance, arc[:, 1]) > 1 for k in (-2, -1, 1, 2)], 0)
    arc = arc[outside & (arc[:, 1] > -height) & (arc[:, 1] > 0 if distance < 2 else True)]
    along = (np.arange(SAMPLES) + 0.5) / SAMPLES * distance
    plane = np.stack([along, np.full(SAMPLES, -height)], -1)
    plane = plane[np.all([np.hypot(along - k * distance, height) > 1 for k in range(-2, 4)], 0)]
    normal = np.concatenate([arc, np.tile([0.0, 1.0], (len(plane), 1))])
    length = np.repeat([2 * np.pi / SAMPLES, distance / SAMPLES], [len(arc), len(plane)])
    return np.concatenate([arc, plane]), normal, length


def _escape_raised(direction, point, normal, distance, height):
    """Whether rays from the profile meet no cylinder above the plane."""
    origin, free = point + 1e-9 * normal, normal @ direction > 0
    for axis in np.arange(-4, 5) * distance:
        to_axis = origin - [axis, 0]
        middle = -to_axis @ direction
        square = middle**2 - np.sum(to_axis**2, -1) + 1
        for sign in (-1, 1):
            time = middle + sign * np.sqrt(np.maximum(square, 0))
            above = origin[:, 1] + time * direction[1] > -height
            free &= ~((square > 0) & (time > 0) & above)
    return free


def _grooved_profile(distance, height):
    """Points, normals and lengths of one period around a groove."""
    count = 2 * SAMPLES
    half_width = min(np.sqrt(1 - height**2), distance / 2)
    step = (np.arange(count) + 0.5) / count
    angle = np.arcsin(half_width) * (2 * step - 1)
    arc = np.stack([np.sin(angle), -np.cos(angle)], -1)
    along = half_width + step * (distance - 2 * half_width)
    plane = np.stack([along, np.full(count, -np.sqrt(1 - half_width**2))], -1)
    normal = np.concatenate([-arc, np.tile([0.0, 1.0], (count, 1))])
    length = np.repeat([2 * np.arcsin(half_width), distance - 2 * half_width], count) / count
    return np.concatenate([arc, plane]), normal, length


def _escape_grooved(direction, point, normal, distance, height):
    """Whether rays that start in the groove are still in it when they come to its opening."""
    half_width = min(np.sqrt(1 - height**2), distance / 2)
    top = -np.sqrt(1 - half_width**2)
    at_top = point[:, 0] + (top - point[:, 1]) / direction[1] * direction[0]
    in_groove = point[:, 1] < top - 1e-9
    return (normal @ direction > 0) & (~in_groove | (np.abs(at_top) < half_width))


def _traced(model, profile, escape, wi, wo):
    """The BRDF as the sum over the points of a profile that see light and viewer."""
    diffuse, specular, n = float(model.diffuse[0]), float(model.specular[0]), float(model.exponent)
    distance, height = float(model.distance), float(model.height)
    point, normal, length = profile(distance, height)
    seen = np.ones(len(point), bool)
    for w in (wi, wo):
        seen &= escape(w[1:] / np.linalg.norm(w[1:]), point, normal, distance, height)
    half = (wi + wo) / np.linalg.norm(wi + wo)
    peak = (n + 2) * (n + 4) / (8 * np.pi * (2 ** (-n / 2) + n))
    material = diffuse / np.pi + specular * peak * np.maximum(normal @ half[1:], 0) ** n
    flux = length * (normal @ wi[1:]) * (normal @ wo[1:])
    return np.sum((flux * material)[seen]) / (distance * wi[2] * wo[2])


SURFACES = {
    "half cylinders side by side": (PoulinFournier, 2.0, 0.0),
    "half cylinders apart": (PoulinFournier, 3.0, 0.0),
    "half cylinders run together": (PoulinFournier, 1.5, 0.0),
    "flat bumps side by side": (PoulinFournier, 1.2, -0.8),
    "flat bumps apart": (PoulinFournier, 4.0, -0.4),
    "bumps run together": (PoulinFournier, 1.2, -0.5),
    "undercut": (PoulinFournier, 2.5, 0.6),
    "whole cylinders apart": (PoulinFournier, 3.5, 1.0),
    "whole cylinders side by side": (PoulinFournier, 2.0, 1.0),
    "half grooves": (PoulinFournierGrooves, 2.0, 0.0),
    "grooves apart": (PoulinFournierGrooves, 3.0, 0.3),
    "grooves run together": (PoulinFournierGrooves, 1.0, 0.2),
    "shallow grooves": (PoulinFournierGrooves, 1.5, 0.9),
}


@pytest.mark.parametrize(("kind", "distance", "height"), SURFACES.values(), ids=SURFACES)
def test_both_models_equal_rays_traced_through_their_profile(kind, distance, height, x64, close):
    parts = (_raised_profile, _escape_raised) if kind is PoulinFournier else (_grooved_profile, _escape_grooved)
    for seed, exponent in enumerate((1.0, 30.0, 1000.0, 10000.0)):
        model = kind(0.4, 0.6, exponent, distance, height)
        wi, wo = _pairs(6, seed)
        expected = [_traced(model, *parts, *pair) for pair in zip(wi, wo, strict=True)]
        found = evaluate(model, jnp.asarray(wi), jnp.asarray(wo))[:, 0]
        close(found, np.array(expected), tolerance=TRACED_TOLERANCE)


@pytest.mark.parametrize("exponent", [0.0, 20.0, 10000.0])
@pytest.mark.parametrize(("kind", "height"), [(PoulinFournier, -1.0), (PoulinFournierGrooves, 1.0)])
def test_without_cylinders_the_surface_is_its_material(kind, height, exponent, x64, close):
    wi, wo = jnp.asarray(_pairs(500))
    material = BlinnPhong(0.4, [0.6, 0.2, 0.1], exponent)
    found = evaluate(kind(0.4, [0.6, 0.2, 0.1], exponent, 2.0, height), wi, wo)
    close(found, evaluate(material, wi, wo), tolerance=1e-6)  # a strip of 1e-7 is left of the cylinders


def test_float32_keeps_the_value(close):
    model = PoulinFournier(0.4, 0.6, 10000.0, 2.3, 0.3)
    wi, wo = _pairs(400)
    found = evaluate(model, jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32))
    with jax.enable_x64(True):
        expected = evaluate(PoulinFournier(0.4, 0.6, 10000.0, 2.3, 0.3), jnp.asarray(wi), jnp.asarray(wo))
    close(found, np.asarray(expected), tolerance=2e-4)  # n sin(x) dx = 1e4 x .06 x 1e-7 at the edge of the lobe
