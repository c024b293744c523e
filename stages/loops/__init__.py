"""Places seen again: descriptors, candidates, verification."""
