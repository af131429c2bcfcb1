"""The figures and tables of the three papers, made again, with what was measured of each.

    python -m benchmarks.figures [NAME ...] [--quick] [--store FOLDER] [--docs FOLDER]

Each figure writes pictures to `docs/figures/pictures` and one JSON line for each number to `docs/figures/lines`.
`benchmarks.figures.pages` writes the tables of the pages from these lines.
"""
