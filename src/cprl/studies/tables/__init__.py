"""Tables of finished runs, of a study or of any at hand.

Modules, in the order in which one reads them:
    tidy_table   StudyTable: what came out, as one tidy table, and under which versions it was made
    sources      which runs a table is made of; their episodes as rows, and in which phase each replica ends
    pooled       the same for any runs at hand, by fields of their experiments
    comparing    means over replicas, and differences from the reference; in Markdown and in the terminal
    effects      main effects and interactions of a grid's factors
"""
