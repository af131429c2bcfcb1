"""Mixtures of densities on the sphere, fitted to weighted samples by expectation-maximization.

Components are von Mises-Fisher lobes, whose weights, means and concentrations are fitted, and fixed densities, of which
only the weights are fitted. Densities are computed as logarithms. The log-likelihood never decreases.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit

_NEWTON = 4  # steps, starting from an approximation with an error of about 1 %
_SHARP = 5.0  # smallest concentration at which the recurrence of Bessel functions is stable
_BESSEL = 16  # orders above the largest wanted one at which the continued fraction starts


class Mixture(eqx.Module):
    """A mixture of von Mises-Fisher lobes: weight k exp(k (mean . x - 1)) / (2 pi (1 - exp(-2 k))), concentration k.

    Attributes:
        weight: Mass of each lobe: its integral over the sphere.
        mean: Mean direction of each lobe, a unit vector.
        concentration: Concentration of each lobe, above 0. For a sharp lobe it is the inverse square of the lobe's
            width in radians.
    """

    weight: Float[Array, "*v l"]
    mean: Float[Array, "*v l 3"]
    concentration: Float[Array, "*v l"]

    def __call__(self, direction: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
        """Density of the mixture at some directions, in mass per steradian."""
        return jnp.sum(self.weight * jnp.exp(log_density(direction, self.mean, self.concentration)), -1)


class MixtureFit(eqx.Module):
    """The result of `fit`.

    Attributes:
        lobe: The fitted lobes.
        fixed: Weights of the fixed densities.
        likelihood: Log-likelihood of the samples, averaged by mass, before the first step and after each step; 0 if
            the samples have no mass.
        residual: Share of the total mass that moved to another component in each step.
    """

    lobe: Mixture
    fixed: Float[Array, " m"]
    likelihood: Float[Array, " _"]
    residual: Float[Array, " _"]


@jit
def log_density(
    direction: Float[Array, "*b 3"], mean: Float[Array, "l 3"], concentration: Float[Array, " l"]
) -> Float[Array, "*b l"]:
    """Logarithm of von Mises-Fisher densities, in 1/sr.

    The angle is computed from the squared distance of the unit vectors, which stays accurate in sharp lobes.
    """
    x, y, z = (direction[..., i, None] - mean[:, i] for i in range(3))
    return log_peak(concentration) - concentration * (x**2 + y**2 + z**2) / 2


@jit
def log_peak(concentration: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Logarithm of the density of a von Mises-Fisher lobe at its mean."""
    return jnp.log(concentration / (2 * np.pi)) - jnp.log(-jnp.expm1(-2 * concentration))


@jit
def drop(concentration: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Mean of 1 - cos(angle to the mean) over a lobe, 1 - coth k + 1/k. For a sharp lobe it is the variance 1/k."""
    small = concentration < 1e-2  # Here the two terms of coth k - 1/k cancel.
    safe = jnp.where(small, 1, concentration)
    far = 1 / safe - 2 * jnp.exp(-2 * safe) / -jnp.expm1(-2 * safe)
    return jnp.where(small, 1 - concentration / 3 + concentration**3 / 45, far)


@partial(jit, static_argnames=("degree",))
def bands(concentration: Float[Array, "*b"], *, degree: int) -> Float[Array, " l *b"]:
    """Factors by which convolution with a von Mises-Fisher lobe scales each band of spherical harmonics.

        A_l = i_l(k) / i_0(k),    A_0 = 1,    A_1 = coth k - 1 / k,    A_(l+1) = A_(l-1) - (2 l + 1) / k A_l

    with modified spherical Bessel functions i_l. Sharp lobes use the recurrence, which is stable for them; wide lobes
    use the continued fraction of the ratios.
    """
    sharp = concentration > _SHARP
    safe = jnp.where(sharp, concentration, _SHARP)
    known = [jnp.ones_like(safe), 1 - drop(safe)]
    for l in range(1, degree):
        known.append(known[-2] - (2 * l + 1) / safe * known[-1])
    safe = jnp.where(sharp, _SHARP, concentration)
    ratio, factor = [jnp.zeros_like(safe)], [jnp.ones_like(safe)]
    for l in range(degree + _BESSEL, 0, -1):
        ratio.append(1 / ((2 * l + 1) / safe + ratio[-1]))
    for step in ratio[::-1][:degree]:
        factor.append(factor[-1] * step)
    return jnp.stack([jnp.where(sharp, a, b) for a, b in zip(known, factor, strict=False)])


@jit
def concentration_of(drop: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Concentration of the lobe with a given mean of 1 - cos(angle), between 0 and 1. It is the inverse of `drop`.

    Reference: Banerjee, Dhillon, Ghosh, Sra 2005, for the first approximation, which Newton's method then refines.
    """
    tiny = jnp.finfo(drop.dtype).tiny ** 0.5
    wanted = jnp.clip(drop, tiny, 1 - 1e-6)
    length = 1 - wanted
    concentration = length * (2 + wanted * length + wanted) / (wanted * (1 + length))

    def newton(_, concentration):
        small = concentration < 0.1
        safe = jnp.where(small, 1, concentration)
        slope = 4 * jnp.exp(-2 * safe) / jnp.expm1(-2 * safe) ** 2 - 1 / safe**2
        slope = jnp.where(small, concentration**2 / 15 - 1 / 3, slope)
        step = concentration - (_drop(concentration) - wanted) / slope
        return jnp.clip(step, concentration / 2, 2 * concentration)

    return jax.lax.fori_loop(0, _NEWTON, newton, concentration)


@partial(jit, static_argnames=("steps",))
def fit(
    sample: Float[Array, "s 3"],
    mass: Float[Array, " s"],
    start: Mixture,
    *,
    extent: Float[Array, " s"] | Float[Array, ""] | float = 0.0,
    fixed: Float[Array, "s m"] | None = None,
    weight: Float[Array, " m"] | None = None,
    least: Float[Array, "*l"] | float = 1e-3,
    most: Float[Array, ""] | float = 1e6,
    steps: int = 50,
) -> MixtureFit:
    """Fits von Mises-Fisher lobes and the weights of fixed densities to weighted samples.

    The components together have the total mass of the samples. A component to which no sample belongs keeps its shape
    and gets weight zero. Components that coincide remain equal. To fit many mixtures at once, use `jax.vmap`.

    Args:
        sample: Directions of the samples, unit vectors.
        mass: Mass of each sample, not negative.
        start: The initial lobes. A weight of zero stays zero.
        extent: Mean of 1 - cos(angle) over the region that a sample represents, such as a texel; 0 for a point. No
            lobe becomes narrower than that.
        fixed: Logarithm of each fixed density at each sample; minus infinity where the density is zero.
        weight: Initial weights of the fixed densities.
        least: Smallest concentration, one for all lobes or one for each.
        most: Largest concentration. Without it, a lobe of a single sample would have an infinite one.
        steps: Number of steps of expectation-maximization.

    Returns:
        The lobes, the weights of the fixed densities, and the convergence history.

    Raises:
        ValueError: Only one of `fixed` and `weight` is given.

    Reference: Dempster, Laird, Rubin 1977; for the lobes Banerjee, Dhillon, Ghosh, Sra 2005.
    """
    if (fixed is None) != (weight is None):
        raise ValueError("fixed densities and their weights must be given together, got only one of them")
    if fixed is None or weight is None:
        fixed, weight = jnp.zeros((len(sample), 0), sample.dtype), jnp.zeros(0, sample.dtype)
    extent = jnp.broadcast_to(jnp.asarray(extent, sample.dtype), mass.shape)
    total = jnp.sum(mass)
    scale = jnp.where(total > 0, total, 1)
    mass = mass / scale
    count = len(start.weight)
    share = jnp.concatenate([start.weight, weight])
    share = share / jnp.where(jnp.sum(share) > 0, jnp.sum(share), 1)

    def expect(share, mean, concentration):
        lobe = log_density(sample, mean, concentration) - extent[:, None] * concentration
        return _expect(jnp.concatenate([lobe, fixed], 1), mass, share)

    def step(carry, _):
        share, mean, concentration, responsibility = carry
        taken = responsibility[:, :count]
        taken_mass = jnp.sum(taken, 0)
        mean = _mean(taken, sample, mean)
        away = sum((sample[:, i, None] - mean[:, i]) ** 2 for i in range(3)) / 2 + extent[:, None]
        spread = jnp.sum(taken * away, 0) / jnp.where(taken_mass > 0, taken_mass, 1)
        sharper = jnp.clip(concentration_of(spread), least, most)
        concentration = jnp.where(taken_mass > 0, sharper, concentration)
        fresh = jnp.sum(responsibility, 0)
        responsibility, likelihood = expect(fresh, mean, concentration)
        return (fresh, mean, concentration, responsibility), (likelihood, jnp.sum(jnp.abs(fresh - share)) / 2)

    responsibility, first = expect(share, start.mean, start.concentration)
    carry = (share, start.mean, start.concentration, responsibility)
    (share, mean, concentration, _), (likelihood, residual) = jax.lax.scan(step, carry, None, length=steps)
    share = share * total
    likelihood = jnp.concatenate([first[None], likelihood])
    return MixtureFit(Mixture(share[:count], mean, concentration), share[count:], likelihood, residual)


@partial(jit, static_argnames=("steps",))
def weigh(
    density: Float[Array, "s m"], mass: Float[Array, " s"], weight: Float[Array, " m"], *, steps: int = 50
) -> tuple[Float[Array, " m"], Float[Array, " _"]]:
    """Fits the weights of fixed densities to weighted samples.

    Args:
        density: Logarithm of each density at each sample; minus infinity where the density is zero.
        mass: Mass of each sample, not negative.
        weight: Initial weights. A weight of zero stays zero.
        steps: Number of steps of expectation-maximization.

    Returns:
        Weights, which sum to the mass of the samples at which any density is positive; and the mean log-likelihood
        before the first step and after each step.

    Reference: Dempster, Laird, Rubin 1977.
    """
    total = jnp.sum(mass)
    mass = mass / jnp.where(total > 0, total, 1)

    def step(weight, _):
        responsibility, likelihood = _expect(density, mass, weight)
        return jnp.sum(responsibility, 0), likelihood

    weight = weight / jnp.where(jnp.sum(weight) > 0, jnp.sum(weight), 1)
    weight, likelihood = jax.lax.scan(step, weight, None, length=steps)
    _, last = _expect(density, mass, weight)
    return weight * total, jnp.concatenate([likelihood, last[None]])


_drop = drop  # `concentration_of` has an argument of the same name.


def _expect(density: Array, mass: Array, weight: Array) -> tuple[Array, Array]:
    """Mass of each sample that belongs to each component, and the log-likelihood."""
    alive = (weight > 0) & (density > -jnp.inf)
    joint = jnp.where(alive, jnp.where(alive, density, 0) + jnp.log(jnp.where(weight > 0, weight, 1)), -jnp.inf)
    best = jnp.max(joint, 1, initial=-jnp.inf)
    known = best > -jnp.inf
    best = jnp.where(known, best, 0)
    part = jnp.exp(joint - best[:, None])
    whole = jnp.sum(part, 1)
    safe = jnp.where(known, whole, 1)
    taken = jnp.where(known, mass, 0)
    likelihood = jnp.sum(taken * (best + jnp.log(safe)))
    return part * (taken / safe)[:, None], likelihood


def _mean(taken: Array, sample: Array, before: Array) -> Array:
    """Mean directions; the previous one where samples cancel or there are none."""
    vector = taken.T @ sample
    length = jnp.linalg.norm(vector, axis=1, keepdims=True)
    known = length > 1e-12
    return jnp.where(known, vector / jnp.where(known, length, 1), before)
