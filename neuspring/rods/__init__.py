"""Elastic rods: their solver in lanes, the specification, nodes that follow a center line, and what a fit starts from.

Fits of rods are `neuspring.twin.rod_fit`, and their answers as a body `neuspring.twin.bodies.rod`.
"""
