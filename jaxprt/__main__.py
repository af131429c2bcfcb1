"""Runs the command line: `python -m jaxprt`."""

import sys

from jaxprt.cli.main import main
from jaxprt.cli.play import keep_programs

if __name__ == "__main__":
    keep_programs()
    sys.exit(main())
