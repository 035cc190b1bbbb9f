"""Where the networks of learned matchers run: `--device`, or `device` of [matchers] in a configuration."""

from typing import TYPE_CHECKING

from orthoswarm.matchers.matcher import UnavailableError
from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    import torch

DEVICES = ("auto", "cpu", "cuda")  # what may be asked for


def network_device(wanted: str = "auto") -> "torch.device":
    """The device asked for, with "auto" CUDA where torch sees a card, else the CPU.

    Raises UnavailableError: CUDA was asked for and torch sees no card, or there is no device of that name.
    """
    import torch

    if wanted not in DEVICES:
        raise UnavailableError(f"there is no device '{wanted}'; choose one of {', '.join(DEVICES)}")
    card = torch.cuda.is_available()
    if wanted == "cuda" and not card:
        raise UnavailableError(
            f"torch {torch.__version__} sees no CUDA card; install a torch that is built for the card, or take the CPU"
        )
    return torch.device("cuda" if card and wanted != "cpu" else "cpu")


def require_device(wanted: str) -> None:
    """Refuse a device that was asked for and is not there, before a run begins; "auto" and "cpu" cost no import.

    Raises InputError: what `network_device` says.
    """
    if wanted in ("auto", "cpu"):
        return
    try:
        network_device(wanted)
    except UnavailableError as error:
        raise InputError(str(error)) from None
