"""The terminal's output about runs, and their figures.

Modules, in the order in which one reads them:
    progress  a bar while a training runs
    course    the course of a run in sentences
    summary   the results of a run: a verdict, a table and the files
    text_tables  tables of texts and estimates, for the terminal, Markdown, LaTeX and CSV
    figures   the training curve
    style     the style of all figures: sizes, colours, title, legend and caption
    picture_files  the files of figures: suffixes, metadata, the colours of a PNG
    panels    the contents of panels: lines, dots with intervals, matrices
"""
