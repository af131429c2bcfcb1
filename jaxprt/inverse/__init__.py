"""Light and materials from pictures of a known object: what explains them best, and how well they determine it.

    pixels = prt.inverse.observe(mesh, [prt.inverse.Picture(image, camera)])
    found = prt.inverse.light(lambda light, eye: radiance(transport, brdf, light, eye=eye), start, pixels)
    found = prt.inverse.material(lambda m, eye: radiance(transport, table.at(m), light, eye=eye), start, pixels)

Any relighting function of any system that JAX can differentiate goes in. Pictures are compared after rasterization,
linear radiance with linear radiance; the residual is in units of the pictures' norm: 0.03 is 3 % off.
"""

from jaxprt.inverse.fit import jointly, light, material
from jaxprt.inverse.pictures import Picture, Pixels, observe, residual, smoothness
from jaxprt.inverse.solve import Fit

__all__ = ["Fit", "Picture", "Pixels", "jointly", "light", "material", "observe", "residual", "smoothness"]
