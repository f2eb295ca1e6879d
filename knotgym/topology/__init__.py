"""Knot theory of the rope's projection: crossings, Gauss codes, diagrams, knots, symmetries.

It needs no simulator.
"""
