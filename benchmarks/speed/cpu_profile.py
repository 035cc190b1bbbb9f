"""Where the CPU time of a run goes, by function.

    python -m benchmarks.speed.cpu_profile mosaic PHOTOS --basemap MAP --out OUT --workers 1

A timer of the process's CPU time looks at the stack, so compiled code counts for the function of this project that
called it, and nothing is slowed down. Other processes are not seen: give `--workers 1`.
"""

import signal
import sys
import time
from collections import Counter
from pathlib import Path
from types import FrameType

INTERVAL_S = 0.002
ROOT = Path(__file__).parents[2]


class StackSampler:
    """Counts, at each tick of the CPU timer, the innermost function of this project.

    Attributes:
        own: (file, function) -> ticks in it, and in what it calls outside of this project.
    """

    def __init__(self) -> None:
        self.own: Counter[tuple[str, str]] = Counter()

    def tick(self, _signal: int, frame: FrameType | None) -> None:
        """The signal's handler."""
        while frame is not None:
            path = Path(frame.f_code.co_filename)
            if path.is_relative_to(ROOT) and ".venv" not in path.parts:
                self.own[str(path.relative_to(ROOT)), frame.f_code.co_name] += 1
                return
            frame = frame.f_back
        self.own["-", "interpreter"] += 1

    def table(self, most: int) -> str:
        """The functions that took most, as lines of CPU seconds, share, and name."""
        ticks, all_s = sum(self.own.values()), time.process_time()
        lines = [f"{all_s:.1f} s of CPU in this process"]
        for (path, function), count in self.own.most_common(most):
            lines.append(f"{all_s * count / ticks:6.2f} s {100 * count / ticks:5.1f} %  {path} {function}")
        return "\n".join(lines)


def main() -> None:
    """Run a verb of `orthoswarm` under the sampler; the table goes to stderr."""
    from gcs_plugin.cli.main import main as orthoswarm

    sampler = StackSampler()
    signal.signal(signal.SIGPROF, sampler.tick)
    signal.setitimer(signal.ITIMER_PROF, INTERVAL_S, INTERVAL_S)
    sys.argv[0] = "orthoswarm"
    try:
        orthoswarm()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        print(sampler.table(40), file=sys.stderr)


if __name__ == "__main__":
    main()
