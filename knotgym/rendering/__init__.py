"""What the rope looks like: the picture, its two renderers, its appearance, what an agent sees."""
