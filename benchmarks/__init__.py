"""One thin script per question; ``harness`` measures and reports."""
