"""Tables of finished runs, of a study or of any at hand.

Modules, in the order in which one reads them:
    sources      which runs a table is made of, and which are lacking
    circumstances  versions, commits and processors of runs, and which differ from the rest
    windows      the episodes of a run as means over windows of them
    rows         the rows of a table, sorted
    table        StudyTable: what came out, as one tidy table
    pooled       the same for any runs at hand, by fields of their experiments
    comparing    means over replicas, and differences from the reference
    texts        comparisons in Markdown and in the terminal
    outcomes     in which phase each replica ends
"""
