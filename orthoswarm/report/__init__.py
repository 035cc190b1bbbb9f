"""The page that says how a map was made and how far it can be trusted, with pictures, in one self-contained file."""
