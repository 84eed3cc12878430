"""Evaluation against ground truth: metrics, rendering of an asset's prediction folder, scores and a contact sheet."""

from tumble.evaluation import metrics
from tumble.evaluation.evaluate import (
    PREDICTION,
    SHEET,
    CaptureWithTruth,
    Report,
    read_with_truth,
    score,
    score_prediction,
)
from tumble.evaluation.prediction import Prediction
from tumble.evaluation.render_prediction import align_views, predict_views

__all__ = [
    "CaptureWithTruth",
    "PREDICTION",
    "Prediction",
    "Report",
    "SHEET",
    "align_views",
    "metrics",
    "predict_views",
    "read_with_truth",
    "score",
    "score_prediction",
]
