"""Runs the command line: `python -m jaxprt`."""

from jaxprt.cli.main import run

if __name__ == "__main__":
    run()
