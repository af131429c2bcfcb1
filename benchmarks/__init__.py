"""One thin script per question; ``harness`` measures and reports."""

import os

os.environ.setdefault("JAXPRT_KEEP_PROGRAMS", "0")  # Times of compiling are those of a first run.
