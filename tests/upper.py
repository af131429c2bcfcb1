"""Directions above the horizon, for tests of BRDFs."""

import jax
import jax.numpy as jnp
import numpy as np


def directions(*polar: tuple[float, float]) -> jax.Array:
    """Unit vectors of (angle to the normal, angle about it), in radians."""
    theta, phi = np.array(polar).T
    vector = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return jnp.asarray(vector.astype(np.float32))


def upper(seed: int, count: int, least: float = 0.0) -> jax.Array:
    """Random unit vectors whose cosine with the normal is at least `least`."""
    random = np.random.default_rng(seed)
    return directions(*np.stack([np.arccos(random.uniform(least, 1, count)), random.uniform(0, 6.28, count)], -1))


def nodes(resolution: int) -> jax.Array:
    """Views at which an isotropic table of lobes is made, but for the one at the horizon."""
    return directions(*((2 * np.arctan(radius), 0.0) for radius in np.linspace(0, 1, resolution)[:-1]))


evaluate = jax.jit(lambda brdf, wi, wo: brdf(wi, wo))


def unit(vector: np.ndarray) -> np.ndarray:
    """Vectors of length 1."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def pairs(count: int, seed: int = 0) -> np.ndarray:
    """Pairs of random unit vectors above the horizon, [2, q, 3], in float64."""
    direction = np.random.default_rng(seed).standard_normal((2, count, 3))
    direction[..., 2] = np.abs(direction[..., 2])
    return unit(direction)


def highlights(width: float, count: int = 4000) -> np.ndarray:
    """Pairs whose half vectors are about as far from the normal as a lobe is wide; 70 degrees at most."""
    random = np.random.default_rng(3)
    wi = random.standard_normal((count, 3))
    wi[:, 2] = 0.4 * np.linalg.norm(wi[:, :2], axis=-1) + np.abs(wi[:, 2])
    wi = unit(wi)
    return np.stack([wi, unit(wi * [-1, -1, 1] + width * random.standard_normal((count, 3)) * [1, 1, 0])])


def albedo(brdf, tilt: float, azimuth: float = 0.65, count: int = 300, around: int = 120) -> np.ndarray:
    """Directional albedo, by the midpoint rule over half vectors, finest around the normal; in float64 under x64."""
    wo = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    step = (np.arange(count) + 0.5) / count
    theta, phi = np.meshgrid(np.pi / 2 * step**3, 2 * np.pi * (np.arange(around) + 0.5) / around, indexing="ij")
    weight = (np.pi / 2 * 3 * step**2 / count)[:, None] * np.sin(theta) * 2 * np.pi / around
    half = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    cosine = half @ wo
    wi = 2 * cosine[..., None] * half - wo
    weight = weight * 4 * np.maximum(cosine, 0) * np.maximum(wi[..., 2], 0)  # d wi = 4 (h.wo) dh
    value = evaluate(brdf, *(x.astype(jnp.result_type(float)) for x in np.broadcast_arrays(wi.reshape(-1, 3), wo)))
    return weight.ravel() @ np.asarray(value)


def relative(difference: np.ndarray, expected: np.ndarray) -> float:
    """The norm of a difference over that of what is expected."""
    return float(np.linalg.norm(difference) / np.linalg.norm(expected))
