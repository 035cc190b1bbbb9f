"""The digital twin: cities, disasters, flights and photos with known truth, after the paper's IV.A.

The paper's data set is not public; this package makes its like, so that every stage can be judged against truth.
Nothing in the product reads what is written under a set's `truth/` folder.
"""
