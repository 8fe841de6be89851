"""Elastic rods: their solver in lanes, the specification, nodes that follow a center line, and what a fit starts from.

Fits of rods are `neuspring.extensions.rods.fit`, and their answers as a body `neuspring.extensions.rods.body`.
"""
