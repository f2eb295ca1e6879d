"""What the rope looks like: the picture, its two renderers, its appearance, and what an agent is
shown.
"""
