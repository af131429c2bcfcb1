"""The command line, and what it reports and animates."""
