"""What all figures share.

Modules, in the order in which one reads them:
    style  sizes and colours of figures on white, and legends beside the data
    bands  phases as bands behind the curves with their names above, and the end of exploration
    cells  cells of a matrix, each with its colour and a text
"""
