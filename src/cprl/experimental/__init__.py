"""The waiting room: what is here works and is tested, and may change from one version to the next.

No other package imports it: the commands, the live view and studies ask `cprl.system.waiting_room` for a part
by its place. What carries the library stands in the other packages. Names are imported from their modules.

Modules, in the order in which one reads them:
    schelling       what cooperators and defectors get, by how many of the others cooperate
    movement        where agents go, which cells they share or keep, and who tags whom
    territory       territory_of: where the agents of a stored run go and whom they tag, beside random play
    payoff_table    PayoffTable: a symmetric game with a few strategies, by how many agents play each
    solutions       Nash equilibria of two agents, alpha-rank and replicator dynamics, by nashpy and OpenSpiel
    empirical_game  play_empirical_game: the game whose strategies are runs; pairwise_game: of a cross-play;
                    analyse: which runs last in it, by alpha-rank, equilibria and replicator dynamics
    exploit         exploitability: trains best responses, a study; play_responses, response_gains and
                    mean_gains: what they gain over the agents whose place they take
    search          run_search: points that Optuna proposes, each run as a condition of a study
    factor_maps     maps of two factors of a study, among its figures
    ray_executor    Ray: runs the trials of a study on the machines of a cluster
    current_policy  CurrentPolicy: the first replica's agents of a training as they are now
    exhibition      a world that the current policy plays, for viewers alone
    lawgiver        Lawgiver: a language model that gives institutions between episodes
    export_turns    fresh episodes for other programs, turn by turn: CSV, Minari
"""
