"""Bases of distant light: texels of a cubemap, spherical harmonics, and patches of the sky."""

import abc
import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap, harmonics, patches

_PLACES = 512  # along the edge of a face, in whole texels, by which patches share these


class Basis(eqx.Module):
    """Functions of the direction, whose sum with coefficients is the radiance of distant light."""

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """Number of functions."""

    @abc.abstractmethod
    def means(self, size: int) -> Any:
        """Mean of each function over each texel of a cubemap [b, 6 n n], dense or as a matrix of SciPy."""

    @abc.abstractmethod
    def project(self, light: Environment) -> Float[Array, "b c"]:
        """The coefficients of an environment."""


class Texels(Basis):
    """The texels of a cubemap with `size` texels along an edge, each with a radiance of its own."""

    size: int = eqx.field(static=True, default=16)

    def __check_init__(self):
        """Refuses sizes that are no powers of two."""
        require.count("size", self.size, least=1)
        if self.size & (self.size - 1):
            raise ValueError(f"size must be a power of two, got {self.size}")

    @property
    def count(self) -> int:
        """Number of texels."""
        return 6 * self.size**2

    def means(self, size: int) -> Any:
        """1 for the texel that holds a finer one."""
        if size % self.size:
            raise ValueError(f"rays must be traced through {self.size} texels along an edge or a multiple, got {size}")
        number = np.arange(self.count).reshape(6, self.size, self.size)
        number = number.repeat(size // self.size, 1).repeat(size // self.size, 2).ravel()
        return _members(np.ones(number.size, np.float32), number, np.arange(number.size), self.count)

    def project(self, light: Environment) -> Float[Array, "b c"]:
        """Radiance of the texels."""
        return cubemap.reduced(light.radiance, size=self.size).reshape(self.count, -1)


class Harmonics(Basis):
    """Real spherical harmonics up to a degree, in the order of `jaxprt.sphere.harmonics`."""

    degree: int = eqx.field(static=True, default=2)

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return (self.degree + 1) ** 2

    def means(self, size: int) -> Any:
        """Means by 4 x 4 places in each texel."""
        basis = harmonics.evaluate(cubemap.direction(size=4 * size), degree=self.degree)
        return np.asarray(cubemap.reduced(basis, size=size).reshape(-1, self.count).T)

    def project(self, light: Environment) -> Float[Array, "b c"]:
        """SH coefficients of the light."""
        return harmonics.project(light.radiance, degree=self.degree)


class Patches(Basis):
    """The ground and the patches of the sky of Tregenza (`subdivision` 1) or Reinhart (2 to 6), each with one radiance.

    `jaxprt.sphere.patches` has their order, which is that of Radiance.
    """

    subdivision: int = eqx.field(static=True, default=1)

    @property
    def count(self) -> int:
        """Number of patches, with the ground."""
        return patches.count(self.subdivision)

    def means(self, size: int) -> Any:
        """Share of each texel that belongs to each patch."""
        return _patch_shares(self.subdivision, size)

    def project(self, light: Environment) -> Float[Array, "b c"]:
        """Mean radiance of the patches."""
        size = light.radiance.shape[-2]
        area = self.means(size).multiply(np.asarray(cubemap.solid_angle(size=size)).reshape(1, -1)).tocsr()
        flux = area @ np.asarray(light.radiance).reshape(area.shape[1], -1)
        return jnp.asarray(flux / np.maximum(np.asarray(area.sum(1)).reshape(-1, 1), 1e-30))


@functools.lru_cache(maxsize=4)
def _patch_shares(subdivision: int, size: int) -> Any:
    fine = max(2, _PLACES // size)
    place = np.asarray(cubemap.direction(size=fine * size), np.float64).reshape(-1, 3)
    number = patches.index_of(place, subdivision=subdivision)
    texel = np.arange(6 * size**2).reshape(6, size, size).repeat(fine, 1).repeat(fine, 2).ravel()
    share = np.asarray(cubemap.solid_angle(size=fine * size), np.float64).ravel()
    whole = np.bincount(texel, share)
    return _members((share / whole[texel]).astype(np.float32), number, texel, patches.count(subdivision))


def _members(share: np.ndarray, row: np.ndarray, texel: np.ndarray, rows: int) -> Any:
    """A sparse matrix from texels to functions; shares of one pair are added."""
    return scipy.sparse.csr_matrix((share, (row, texel)), shape=(rows, int(texel.max()) + 1))
