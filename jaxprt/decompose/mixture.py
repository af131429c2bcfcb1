"""Mixtures of densities, fitted by Expectation-Maximization to samples that carry mass.

Components are von Mises-Fisher lobes on the sphere, whose weights, means and concentrations are free, beside fixed
densities of which only the weights are. Everything is in logarithms; the log-likelihood never falls.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit

_NEWTON = 4  # steps from an approximation that is right to a percent
_SHARP = 5.0  # concentration from which a recurrence of Bessel functions is stable, and
_BESSEL = 16  # orders above those asked for where a continued fraction begins


class Mixture(eqx.Module):
    """Von Mises-Fisher lobes, weight k exp(k (mean . x - 1)) / (2 pi (1 - exp(-2 k))) for concentration k.

    Attributes:
        weight: Mass of each lobe.
        mean: Unit vectors.
        concentration: Of each lobe, above 0; for a sharp lobe the inverse square of its width in radians.
    """

    weight: Float[Array, "*v l"]
    mean: Float[Array, "*v l 3"]
    concentration: Float[Array, "*v l"]

    def __call__(self, direction: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
        """Mass per steradian at some directions."""
        return jnp.sum(self.weight * jnp.exp(log_density(direction, self.mean, self.concentration)), -1)


class Fit(eqx.Module):
    """What a fit returns.

    Attributes:
        lobe: The free components.
        fixed: Weights of the fixed components.
        likelihood: Mean log-likelihood of the samples by mass, before the first step and after each; without mass 0.
        residual: Mass that changed its component in each step, as a share of the whole.
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

    The angle enters as the squared distance of the unit vectors, which keeps its digits in sharp lobes.
    """
    x, y, z = (direction[..., i, None] - mean[:, i] for i in range(3))
    return log_peak(concentration) - concentration * (x**2 + y**2 + z**2) / 2


@jit
def log_peak(concentration: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Logarithm of the density of a von Mises-Fisher lobe at its mean."""
    return jnp.log(concentration / (2 * np.pi)) - jnp.log(-jnp.expm1(-2 * concentration))


@jit
def drop(concentration: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """1 - cos of the angle to the mean, averaged over a lobe: 1 - coth k + 1/k. For a sharp lobe its variance 1/k."""
    small = concentration < 1e-2  # There the two terms of coth k - 1/k cancel.
    safe = jnp.where(small, 1, concentration)
    far = 1 / safe - 2 * jnp.exp(-2 * safe) / -jnp.expm1(-2 * safe)
    return jnp.where(small, 1 - concentration / 3 + concentration**3 / 45, far)


@partial(jit, static_argnames=("degree",))
def bands(concentration: Float[Array, "*b"], *, degree: int) -> Float[Array, "l *b"]:
    """What a von Mises-Fisher lobe leaves of each band of the harmonics that it is averaged over.

        A_l = i_l(k) / i_0(k),    A_0 = 1,    A_1 = coth k - 1 / k,    A_(l+1) = A_(l-1) - (2 l + 1) / k A_l

    with modified spherical Bessel functions i_l: by their recurrence for sharp lobes, where it is stable, and for wide
    ones by the continued fraction of their ratios.
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
    for each in ratio[::-1][:degree]:
        factor.append(factor[-1] * each)
    return jnp.stack([jnp.where(sharp, a, b) for a, b in zip(known, factor, strict=False)])


@jit
def concentration_of(drop: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Concentration whose mean 1 - cos is given, between 0 and 1; the inverse of `drop`.

    Reference: Banerjee, Dhillon, Ghosh, Sra 2005, for the first approximation; then Newton's method.
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
) -> Fit:
    """Fits lobes, and the weights of fixed densities beside them, to samples with mass.

    The mass of all components is that of all samples. A component that no sample chooses keeps its shape and weighs
    nothing; components that coincide stay so. To fit many mixtures at once, use `jax.vmap`.

    Args:
        sample: Unit vectors.
        mass: Mass of each, not negative.
        start: The lobes to begin with. A weight of zero stays zero.
        extent: Mean of 1 - cos of the angle to a sample over what it stands for, in place of a point: no lobe becomes
            finer than that.
        fixed: Logarithm of each fixed density at each sample; minus infinity where there is none.
        weight: Weights of the fixed densities to begin with.
        least: Smallest concentration of a lobe, or of each.
        most: Largest concentration of a lobe: a sample alone would have an infinite one.
        steps: Number of steps.

    Returns:
        The mixture, the weights, and how the fit went.

    Raises:
        ValueError: Fixed densities without weights, or weights without them.

    Reference: Dempster, Laird, Rubin 1977; for the lobes Banerjee, Dhillon, Ghosh, Sra 2005.
    """
    if (fixed is None) != (weight is None):
        raise ValueError("fixed densities and their weights must be given together")
    if fixed is None or weight is None:
        fixed, weight = jnp.zeros((len(sample), 0), sample.dtype), jnp.zeros(0, sample.dtype)
    extent = jnp.broadcast_to(jnp.asarray(extent, sample.dtype), mass.shape)
    total = jnp.sum(mass)
    scale = jnp.where(total > 0, total, 1)
    mass = mass / scale
    count = len(start.weight)
    every = jnp.concatenate([start.weight, weight])
    every = every / jnp.where(jnp.sum(every) > 0, jnp.sum(every), 1)

    def expect(every, mean, concentration):
        lobe = log_density(sample, mean, concentration) - extent[:, None] * concentration
        return _expect(jnp.concatenate([lobe, fixed], 1), mass, every)

    def step(carry, _):
        every, mean, concentration, responsibility = carry
        taken = responsibility[:, :count]
        found = jnp.sum(taken, 0)
        mean = _mean(taken, sample, mean)
        away = sum((sample[:, i, None] - mean[:, i]) ** 2 for i in range(3)) / 2 + extent[:, None]
        spread = jnp.sum(taken * away, 0) / jnp.where(found > 0, found, 1)
        sharper = jnp.clip(concentration_of(spread), least, most)
        concentration = jnp.where(found > 0, sharper, concentration)
        fresh = jnp.sum(responsibility, 0)
        responsibility, likelihood = expect(fresh, mean, concentration)
        return (fresh, mean, concentration, responsibility), (likelihood, jnp.sum(jnp.abs(fresh - every)) / 2)

    responsibility, first = expect(every, start.mean, start.concentration)
    carry = (every, start.mean, start.concentration, responsibility)
    (every, mean, concentration, _), (likelihood, residual) = jax.lax.scan(step, carry, None, length=steps)
    every = every * total
    likelihood = jnp.concatenate([first[None], likelihood])
    return Fit(Mixture(every[:count], mean, concentration), every[count:], likelihood, residual)


@partial(jit, static_argnames=("steps",))
def weigh(
    density: Float[Array, "s m"], mass: Float[Array, " s"], weight: Float[Array, " m"], *, steps: int = 50
) -> tuple[Float[Array, " m"], Float[Array, " _"]]:
    """Weights of fixed densities, fitted to samples with mass.

    Args:
        density: Logarithm of each density at each sample; minus infinity where there is none.
        mass: Mass of each sample, not negative.
        weight: The weights to begin with. One of zero stays zero.
        steps: Number of steps.

    Returns:
        Weights, whose sum is the mass of the samples that any density explains; and the mean log-likelihood before
        the first step and after each.

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


_drop = drop  # The argument of `concentration_of` hides the function.


def _expect(density: Array, mass: Array, weight: Array) -> tuple[Array, Array]:
    """Mass that each component takes of each sample, and the log-likelihood."""
    alive = (weight > 0) & (density > -jnp.inf)
    each = jnp.where(alive, jnp.where(alive, density, 0) + jnp.log(jnp.where(weight > 0, weight, 1)), -jnp.inf)
    best = jnp.max(each, 1, initial=-jnp.inf)
    known = best > -jnp.inf
    best = jnp.where(known, best, 0)
    part = jnp.exp(each - best[:, None])
    whole = jnp.sum(part, 1)
    safe = jnp.where(known, whole, 1)
    taken = jnp.where(known, mass, 0)
    likelihood = jnp.sum(taken * (best + jnp.log(safe)))
    return part * (taken / safe)[:, None], likelihood


def _mean(taken: Array, sample: Array, before: Array) -> Array:
    """Mean directions; where samples cancel, or there are none, the one before."""
    vector = taken.T @ sample
    length = jnp.linalg.norm(vector, axis=1, keepdims=True)
    known = length > 1e-12
    return jnp.where(known, vector / jnp.where(known, length, 1), before)
