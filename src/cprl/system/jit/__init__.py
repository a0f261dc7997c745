"""Compile rules by Numba: plain Python functions, together with all functions of cprl that they call.

Modules in reading order:
    records     named tuples of arrays, passed by reference in compiled code
    linking     joins a function and all that it calls to one piece of machine code
    code_key    a hash of all code that a function can reach
    disk_cache  keeps compiled functions on disk, for all processes
    compiled    compiles functions for the CPU or the GPU, or runs them as plain Python
"""
