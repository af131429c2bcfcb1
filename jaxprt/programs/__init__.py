"""Compiled programs that survive the process, in a folder of the user's cache."""
