"""The digital twin: cities, disasters, flights and photos with known truth, after the paper's IV.A.

The paper's data set is not public. This package makes a comparable one, so that every stage can be measured against
the truth. No other part of OrthoSwarm reads a set's `truth/` folder, apart from the evaluation.
"""
