"""Errors of a reconstruction against the truth, as the field defines them and in Euclidean terms."""

from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.metrics.evaluation import Evaluation, evaluate

__all__ = ["Evaluation", "align_similarity", "evaluate"]
