"""Which stages, wired for a purpose, and the command line."""
