"""Matrix, tensor and density factorizations. They depend on neither BRDFs nor meshes."""

from jaxprt.decompose import eigen, mixture, tucker

__all__ = ["eigen", "mixture", "tucker"]
