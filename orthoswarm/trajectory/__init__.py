"""The flown path: straight legs, and whether they lead in one direction only."""
