"""How good a prediction is: metrics, the prediction of an asset, scores against truth, and a sheet of pictures."""

from tumble.evaluation import metrics
from tumble.evaluation.evaluate import Report, Subject, read_subject, score
from tumble.evaluation.render_prediction import align_views, predict_views

__all__ = [
    "Report",
    "Subject",
    "align_views",
    "metrics",
    "predict_views",
    "read_subject",
    "score",
]
