"""The command line: its commands, reports and animations."""
