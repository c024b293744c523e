"""Exports: a finished map in the formats of other programs."""
