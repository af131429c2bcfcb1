"""What the papers' figures, tables and benchmarks need and no scene does: published variants and thresholds.

`jaxprt` has the methods in the form that relights scenes best. Where the papers' form differs, it stands here, beside
the figures that show it.
"""
