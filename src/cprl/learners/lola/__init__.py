"""How teams learn with opponent-learning awareness (LOLA).

Modules, in the order in which one reads them:
    settings  LOLASettings: the hyperparameters
    steps     an optimiser of all members
    networks  the members' networks of all replicas: who acts, who learns, who has looked ahead
    learner   LOLALearner: rollouts of the present weights, and of weights ahead
"""
