"""Games for people: boards as images, and rules in words. The game itself needs none of it.

Modules in reading order:

    colours          the palette of all pictures for people
    image            draws a board as pixels; agents have a number, a heading and a mark
    episode_picture  draws an episode turn by turn: board, apples and harvests in one picture
    readable         says a game's rules and institutions in words
    decoding         turns observations back into classes of cells, for viewers and for scripted policies
"""
