"""Runs the command line: `python -m jaxprt`."""

import sys

from jaxprt.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
