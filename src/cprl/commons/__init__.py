"""The game itself, in numpy and Numba, without torch and without any learning.

The rules of a turn are plain Python functions, each about one world. Numba compiles them for CPU threads or a
GPU, where a loop calls them for each of B worlds.

Letters, here and in shapes of arrays: B worlds, N agents, K sites (cells where apples grow), H x W cells of
the board, and C channels of an observation of X rows and Y columns.

Modules in reading order. How a game is described:

    rules        Rules: every number of the game, with unit, range and source
    maps         Map: boards that are drawn, known by name, or generated
    named_games  the published games and those of the literature by name
    literature   the games of other programs and papers by name
    spaces       Spaces: the shapes of observations and the number of actions
    observation  Observation: the form in which agents observe the game
    game         Game: a map, its rules, its observations and its institutions
    cells        the classes of cells, and the colours in which agents observe them
    headings     the four headings, and the step to the cell ahead
    near         finds the sites that are near each other
    yields       the sustainable yield of a map: a proven lower bound

The rules, each on one world, and the arrays that they work on:

    tables       Tables: a game as lookup tables for the compiled rules
    chance       counter-based random numbers
    world        the arrays of B worlds: state, output of a step, working memory
    moves        walking, clashes, and the return of tagged agents
    beam         beams, hits and tags
    actions      an agent's action: walk, turn, fire, clean, signal
    apples       harvest and regrowth
    views        the picture of the board and the observations of agents
    turn         the order of events in a turn and in an episode
    loops        the loops over worlds that a thread runs

Groups of rules that are off by default have a module each, see `RuleGroups` in rules: `river`, about waste in
a river and its cleaning, `signals`, which agents send each other, and `quirks`, in which the program of 2019
differs from its paper.

How the rules are run, which `cprl.system.jit` compiles:

    threads      CpuThreads: runs the loops on CPU threads
    cuda         CudaThreads: runs the loops on a GPU
    state        checks a saved state before it is restored
    batch        Batch: B worlds, played a turn at a time
"""
