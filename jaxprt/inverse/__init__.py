"""Light and materials from pictures of a known object, and how well the pictures determine them.

    pixels = prt.inverse.observe(mesh, [prt.inverse.Picture(image, camera)])
    found = prt.inverse.light(lambda light, eye: radiance(transport, brdf, light, eye=eye), start, pixels)
    found = prt.inverse.material(lambda m, eye: radiance(transport, table.at(m), light, eye=eye), start, pixels)

Any relighting function that JAX can differentiate will do. The fit compares linear radiance at pixels, after
rasterization. Residuals are relative to the norm of the pictures: 0.03 means 3 % off.
"""

from jaxprt.inverse.fit import jointly, light, material
from jaxprt.inverse.pictures import Observations, Picture, observe, residual, smoothness
from jaxprt.inverse.solve import Fit

__all__ = ["Fit", "Observations", "Picture", "jointly", "light", "material", "observe", "residual", "smoothness"]
