"""Evaluation: how good odometry, loops, poses and map are."""

from scanloom.stages.evaluation.stage import evaluation

__all__ = ["evaluation"]
