"""Games for people: boards as images, rules in words, the colours of all pictures. The game needs none of it.

In reading order:

    colours   the palette of all pictures for people
    image     a board as pixels, in which agents have number, heading and second mark
    svg       the board of a map as SVG
    readable  a game's rules and institutions in words
    decoding  observations back to classes of cells, for viewers and for policies that read them
"""
