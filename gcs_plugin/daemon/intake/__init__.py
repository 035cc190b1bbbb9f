"""Intake of pictures and poses: posted, from streams, from watched folders, each picture once."""
