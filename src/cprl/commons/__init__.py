"""The game, in numpy and Numba. It knows nothing of torch or of learning.

In reading order:

    rules        every number of the game, with unit, range and source
    maps         boards: drawn, named or generated
    published    the published games by name: boards with their rules
    literature   the games of other programs and papers by name
    spaces       what agents of a game observe and may do, in numbers
    observation  what agents observe, and in which form
    game         Game: a map, its rules and its observations; the memory that worlds of it take
    cells        the classes of cells, and the colours in which agents observe them
    headings     the four headings, and the step to the cell ahead
    near         which sites are near each other
    yields       what a map can bear: a proven lower bound
    tables       a game as lookup tables for the compiled rules
    chance       counter-based random numbers
    world        the arrays of B worlds: state, step output, scratch memory
    moves        walking, clashes, and how agents return to play, on one world
    quirks       a group of rules: what only the program of 2019 does
    beam         beams, hits and tags, on one world
    river        a group of rules: waste in a river, and how it is cleaned
    actions      what an agent does with its action, on one world
    apples       harvest and regrowth, on one world
    views        the picture of the board and the agents' windows, on one world
    turn         the order of a turn and of an episode, on one world
    loops        the loops over worlds that a thread runs
    records      records of arrays, as compiled code hands them on
    linking      rules as parts of one piece of machine code
    compiled     compiles the rules for a target, or runs them as plain Python
    threads      CpuThreads: runs the loops on CPU threads
    cuda         CudaThreads: runs the loops on a GPU
    state        reads, checks and restores the state of B worlds
    batch        Batch: B worlds, played a turn at a time
"""
