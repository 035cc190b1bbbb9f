"""The processor that kernels are compiled for: one that nearly all machines have, so that its code can be shipped.

Machines that run the same code also agree in the last digits of their results.
"""

import os
import platform
from typing import Final

import numba
from llvmlite.binding import get_host_cpu_features

_V3: Final = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
"""What the level x86-64-v3 adds (x86-64 psABI): Intel since Haswell (2013), AMD since Excavator (2015)."""


def choose() -> None:
    """Have numba compile for x86-64-v3 or a generic aarch64 if this machine is one and the user chose nothing.

    Must run before anything is compiled. Child processes inherit the environment.
    """
    baseline = _baseline()
    if baseline and not {"NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"} & set(os.environ):
        os.environ |= {"NUMBA_CPU_NAME": baseline, "NUMBA_CPU_FEATURES": ""}
        numba.config.CPU_NAME, numba.config.CPU_FEATURES = baseline, ""  # it has read its environment already


def fuses() -> bool:
    """Whether the processor compiled for multiplies and adds in one instruction."""
    name = os.environ.get("NUMBA_CPU_NAME")
    return name == _baseline() if name else bool(get_host_cpu_features().get("fma")) or _is_arm()


def _baseline() -> str:
    """Its name for LLVM, empty if this machine falls short of it."""
    if _is_arm():
        return "generic"
    has = get_host_cpu_features()
    return "x86-64-v3" if all(has.get(feature) for feature in _V3) else ""


def _is_arm() -> bool:
    return platform.machine().lower() in ("arm64", "aarch64")
