"""Simulation: a drive through a procedural town, as a log and its truth."""

from scanloom.stages.simulate.stage import simulate

__all__ = ["simulate"]
