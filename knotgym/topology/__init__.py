"""Knot theory of the rope's projection: crossings, Gauss codes, diagrams, knot types, symmetries;
no simulator.
"""
