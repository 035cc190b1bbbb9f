"""Other programs on the same photos, judged by the true map."""
