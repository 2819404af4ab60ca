"""Evaluation of localization: errors per frame, scores per scene, forgetting over scenes."""

from evercal.evaluation.metrics import ContinualScores as ContinualScores
from evercal.evaluation.metrics import FrameResult as FrameResult
from evercal.evaluation.metrics import SceneScores as SceneScores
from evercal.evaluation.metrics import Scores as Scores
from evercal.evaluation.metrics import continual_scores as continual_scores
from evercal.evaluation.metrics import correct as correct
from evercal.evaluation.metrics import recall_area as recall_area
from evercal.evaluation.metrics import scores as scores
from evercal.evaluation.metrics import share_inside as share_inside
from evercal.evaluation.protocol import evaluate as evaluate
