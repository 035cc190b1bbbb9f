"""The package's exceptions; each message is one sentence that tells the user what to do next."""


class OrthoSwarmError(Exception):
    """Nothing could be made of otherwise valid input (exit code 1)."""

    exit_code = 1


class InputError(OrthoSwarmError):
    """An argument or an input file is wrong (exit code 2)."""

    exit_code = 2


class AdjustmentError(OrthoSwarmError):
    """Pictures of a vehicle do not hold together: their adjustment is singular."""
