"""Knot theory of the rope's projection: crossings, Gauss codes, diagrams, knots, symmetries.

Nothing here needs the simulator.
"""
