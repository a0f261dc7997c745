"""The numbers of a DQN agent, with their units and sources."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DQNSettings:
    """Hyper-parameters of one independent DQN agent; the defaults are the published ones.

    Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), appendix A,
    and, for the last five, the program it was run with.
    """

    buffer_size: int = 100_000
    """Transitions kept by the replay buffer."""
    batch_size: int = 8
    """Transitions sampled for an update."""
    learning_starts: int = 16
    """Transitions stored before the first update; from then on one update per environment step."""
    gamma: float = 0.995
    """Discount per step."""
    learning_rate: float = 1e-5
    """Adam's step size."""
    adam_eps: float = 1e-8
    """Added to Adam's denominator; 1e-7 as run."""
    hidden_cells: tuple[int, ...] = (32, 32)
    """Units of each hidden layer, with ReLU."""
    epsilon_start: float = 1.0
    """Chance of a random action at first."""
    epsilon_end: float = 0.1
    """Chance of a random action after the decay."""
    epsilon_hold_steps: int = 800
    """Steps at `epsilon_start` before the decay."""
    epsilon_decay_steps: int = 500_000
    """Steps of the linear decay that follow."""
    epsilon_evaluation: float = 0.05
    """Chance of a random action in evaluation."""
    target_every_episodes: int = 3
    """Episodes between copies of the network to its target; experiment 5 was run with 3 or 10."""
    relu_on_outputs: bool = False
    """[run] ReLU on the Q values too."""
    glorot_uniform: bool = False
    """[run] Glorot-uniform weights and zero biases, else torch's default initialisation."""
    own_target_weights: bool = False
    """[run] The target network starts from weights of its own, else as a copy."""
    mean_over_all_outputs: bool = False
    """[run] The squared error is averaged over all outputs, of which all but the chosen one count zero;
    else over the batch alone."""

    def epsilon(self, step: int) -> float:
        """The chance of a random action at a step, counted from 0."""
        done = min(1.0, max(0.0, (step - self.epsilon_hold_steps) / self.epsilon_decay_steps))
        return self.epsilon_start + done * (self.epsilon_end - self.epsilon_start)
