"""Verbs that say what a finished map shows of the ground, and what it does not."""
