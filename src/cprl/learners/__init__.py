"""How agents learn, many at once.

Modules, in the order in which one reads them:
    settings     the hyper-parameters, with their units and sources
    base         who learns, and what the training loop asks of a learner
    transitions  the turns of some agents, as replay and rollouts store them
    ring         the replay buffer of all lanes
    engine       one update of all lanes: with a lane axis, vmapped, or as a list of stock parts; compiled
    trial        which way of updating fits a user's loss, and which losses are refused
    lanes        a lane is one agent of one replica, or a team: seeds, networks, actors
    replay       ReplayLearner: learns from a replay buffer
    rollouts     RolloutLearner: learns from rollouts of the present policy
    reference    both by stock TorchRL parts, one agent after the other
    lola         LOLALearner: learns with the other members' learning in view
    tabular      TabularLearner: Q-learning in tables
"""
