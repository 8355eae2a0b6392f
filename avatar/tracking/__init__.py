"""A frame's tracking as values that may move, and how well an avatar's picture of the frame fits with them.

`motion` says what may move, `parameterization` how far, `frame_fitter` how well a picture fits and how that changes,
`descent` finds a frame's best values. Refinement moves every frame of a subject so; training its own frames step by step.
"""
