"""Evaluation of localization: errors per frame, scores per scene, forgetting over scenes."""

from evercal.evaluation.metrics import (
    ContinualScores as ContinualScores,
    FrameResult as FrameResult,
    SceneScores as SceneScores,
    Scores as Scores,
    continual_scores as continual_scores,
    correct as correct,
    recall_area as recall_area,
    scores as scores,
    share_inside as share_inside,
)
from evercal.evaluation.protocol import evaluate as evaluate
