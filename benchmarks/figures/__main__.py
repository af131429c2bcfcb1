"""Makes the figures of the papers again: `python -m benchmarks.figures sun2007_figure_5`."""

import argparse
import pathlib
from collections.abc import Sequence

from benchmarks.figures import kautz2002, pages, sun2007, sun2007_scenes, wang2004
from benchmarks.figures.run import Run, record

FIGURES = {
    **sun2007_scenes.FIGURES,
    "sun2007_figure_4": sun2007.figure_4,
    "sun2007_figure_5": sun2007.figure_5,
    "sun2007_figure_6": sun2007.figure_6,
    "sun2007_figure_7": sun2007.figure_7,
    "sun2007_principal": sun2007.principal,
    "kautz2002_figure_1": kautz2002.figure_1,
    "kautz2002_figure_2": kautz2002.figure_2,
    "kautz2002_figure_3": kautz2002.figure_3,
    "kautz2002_figure_7": kautz2002.figure_7,
    "kautz2002_figure_8": kautz2002.figure_8,
    "kautz2002_table_1": kautz2002.table_1,
    "wang2004_figure_1": wang2004.figure_1,
    "wang2004_figure_3": wang2004.figure_3,
    "wang2004_figure_4": wang2004.figure_4,
    "wang2004_figure_4_bunny": wang2004.figure_4_bunny,
    "wang2004_varying": wang2004.varying,
    "wang2004_table_2": wang2004.table_2,
}


def main(options: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("name", nargs="*", metavar="NAME", help=f"figures, all if none: {', '.join(FIGURES)}")
    parser.add_argument("--quick", action="store_true", help="embedded scenes and small sizes")
    parser.add_argument("--store", type=pathlib.Path, default=pathlib.Path("output/figures"), metavar="FOLDER")
    parser.add_argument("--docs", type=pathlib.Path, default=pathlib.Path("docs/figures"), metavar="FOLDER")
    parser.add_argument("--missing", action="store_true", help="only figures that have no lines yet")
    arguments = parser.parse_args(options)
    unknown = [name for name in arguments.name if name not in FIGURES]
    if unknown:
        parser.error(f"figures must be among {', '.join(FIGURES)}, got {', '.join(unknown)}")
    run = Run(arguments.quick, arguments.store, arguments.docs)
    for name in arguments.name or FIGURES:
        if not (arguments.missing and (run.docs / "lines" / f"{name}.jsonl").is_file()):
            record(run, name, FIGURES[name])
    pages.write(run.docs)


if __name__ == "__main__":
    main()
