"""Terminal output and figures of a run.

Modules, in the order in which one reads them:
    progress  a bar while a training runs
    course    the course of a run in sentences
    summary   what a run came to
    tables    tables of texts, for the terminal and for Markdown
    figures   the training curve
    style     what all figures share: sizes, colours, legends
    panels    what they draw into a panel: lines, dots with intervals, matrices
"""
