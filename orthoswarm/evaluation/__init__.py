"""Accuracy against a reference: displacements of an orthoimage, errors of camera poses and of their stated sigma."""
