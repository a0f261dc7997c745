"""A callback for trials whose processes are killed: a checkpoint every 0.05 s, and a number of deaths.

The file that $DEATHS names, if there is one, says how many processes are still to die of SIGKILL.
"""

import os
import signal
import sys
from pathlib import Path

from cprl.runs.checkpoints import Checkpointer

if "--trial" in sys.argv:  # in the process of a trial, not in that of the tests, which import this too
    Checkpointer.__init__.__kwdefaults__["every_s"] = 0.05
DIES_AT_STEP = 200


class OftenSaved:
    """Counts the steps of its process."""

    is_extendable = True

    def __init__(self):
        self.steps = 0

    def on_step(self, batch):
        self.steps += 1
        path = Path(os.environ.get("DEATHS", ""))
        if self.steps == DIES_AT_STEP and path.is_file() and (deaths := int(path.read_text())):
            path.write_text(str(deaths - 1))
            os.kill(os.getpid(), signal.SIGKILL)
