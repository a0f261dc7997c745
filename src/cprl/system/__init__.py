"""The process and the libraries under it: compilation, caches, memory, output.

Modules:
    libraries      what an upgrade of a library has taken away, said by name
    compat         what relies on private parts of libraries, a module a library
    jit            functions compiled by Numba: the rules of the game
    compiling      functions compiled by torch, and what that leaves in memory
    memory         devices, and what would not fit into their memory
    output         text for the terminal
    process        settings of the process that trains, and where compiled code is kept
    shipped        the recipes that come with cprl, and how a command is typed again
    defaults       defaults that functions share with the command line
    waiting_room   what cprl.experimental offers, for those who ask by its place
    working        says what the process does where it takes more than a second
    times          where the time of a training goes; whether code is being compiled
"""
