"""When learners from replay update: from `learning_starts` steps on, after every `steps_per_update` steps."""

from cprl.learners.settings import DQNSettings


class Pace:
    """Counts the environment steps for which a learner owes an update.

    Args:
        settings: the hyperparameters.
    """

    def __init__(self, settings: DQNSettings) -> None:
        self._settings = settings
        self.owed = 0
        """Steps since the last update, of those that count."""

    def stored(self, steps: int) -> None:
        """Counts a step; it is the one of this number, from 1."""
        self.owed += steps >= self._settings.learning_starts

    def take(self, steps: int) -> bool:
        """Whether to update now, after so many steps; that update is then owed no more. One that updates
        after every step may do so whenever it asks."""
        every = self._settings.steps_per_update
        if steps < self._settings.learning_starts or (every > 1 and self.owed < every):
            return False
        self.owed = max(0, self.owed - every)
        return True
