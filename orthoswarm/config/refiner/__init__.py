"""Thresholds of the refiners: of the default one one module a stage, of the paper's one for all."""
