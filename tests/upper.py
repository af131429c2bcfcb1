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
