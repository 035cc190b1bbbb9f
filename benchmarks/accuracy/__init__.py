"""How right the results are, and how true their stated errors, against truth that is known."""
