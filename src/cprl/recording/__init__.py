"""What is kept of a run: its recipe, its table of episodes, its recording, figures and weights."""

from cprl.recording.checkpoints import Checkpoints
from cprl.recording.figures import training_curve
from cprl.recording.progress import ProgressBar
from cprl.recording.rerun import RerunLogger
from cprl.recording.results import EpisodeTable, read_episodes
from cprl.recording.run import start_run
from cprl.recording.streams import check_watch
from cprl.recording.summary import summarise
from cprl.recording.watch import Watch
from cprl.recording.weights import BestWeights, load_weights, restore_weights, save_weights

__all__ = [
    "BestWeights",
    "Checkpoints",
    "EpisodeTable",
    "ProgressBar",
    "RerunLogger",
    "Watch",
    "check_watch",
    "load_weights",
    "read_episodes",
    "restore_weights",
    "save_weights",
    "start_run",
    "summarise",
    "training_curve",
]
