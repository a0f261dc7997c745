"""How agents learn, many at once.

Modules, in the order in which one reads them:
    plain          the same by TorchRL's stock parts, one agent after the other; a training in one function
    settings       the hyperparameters, with their units and sources
    learner        Learner: an algorithm, its lanes, their memory and networks; what it asks of an algorithm
    lanes          Lanes: who learns apart; one agent of one replica, or a team
    transitions    the turns of some agents, as memories store them
    draw           Draw: a batch to learn from that is not yet gathered
    ring           the replay buffer of all lanes
    replay         Replay: learns from the latest turns, in any order
    rollouts       Rollouts: learns from the latest turns of the present policy
    networks       LaneNetworks: the networks of all lanes, which act and learn; stacked, vmapped or a list
    optimizers     how a gradient changes weights
    choose_update  how the lanes of a user's loss are updated
    kept           what a loss keeps from call to call
    refusals       which losses and networks are refused
    lola           the memory and networks of teams that learn with the others' learning in view
    tabular        TabularLearner: Q-learning in tables
    base           what the training loop asks of any learner
"""
