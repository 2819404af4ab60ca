"""The questions a paper asks: how accurate, how much was forgotten, and how sure is that."""

from evercal.continual.benchmark.statistics import Interval as Interval
from evercal.continual.benchmark.statistics import frame_pieces as frame_pieces
from evercal.continual.benchmark.statistics import mean_interval as mean_interval
from evercal.continual.benchmark.statistics import paired_difference as paired_difference
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
