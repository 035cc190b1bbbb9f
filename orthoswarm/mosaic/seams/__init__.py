"""Seam lines by cost: small copies of the pictures, candidates of each cell, relaxation, feathering."""
