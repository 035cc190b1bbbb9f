"""The flown path: straight legs, whether they lead in one direction only, and paths near each other."""
