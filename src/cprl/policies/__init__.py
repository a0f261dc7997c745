"""Policies: they map what agents observe to actions.

Modules, in the order in which one reads them:
    actors          LaneActor: an actor of many agents at once, which reads their networks' values or logits
    scripted        ScriptedActor: agents that follow a fixed rule and do not learn
    scripted_rules  the rules of scripted agents, as functions that are compiled
    asking          Calls: asks a language model, and keeps what it answers
    language        LanguageActor: agents for which a language model makes plans
    tabular         tables of action values, in which agents look actions up
    decisions       Decider: how agents vote and elect; Bandit: how they learn to
    governors       how governors decide: StockRule, Constant, GovernorActor
    joint_policy    JointPolicy: the policy of all agents of a game, made of their actors
    recorded_policy RecordedPolicy: an episode that was played, action by action
    rng             names and seeds of lanes, and independent random numbers for each lane
"""
