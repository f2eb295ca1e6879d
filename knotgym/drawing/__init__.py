"""Ropes drawn from Gauss codes: a code's planar map, packed with circles, eased, and lifted."""
