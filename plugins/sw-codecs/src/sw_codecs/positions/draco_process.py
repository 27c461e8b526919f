"""Decodes a Draco file from standard input to i32 points on standard output, within limits; run as a program.

Arguments: bytes of address space, seconds of processor time, number of points. Apart from the package, so that it loads
neither torch nor anything else that takes time or memory.
"""

import sys

import numpy as np


def main(memory: int, seconds: int, count: int) -> None:
    import DracoPy

    try:
        import resource
    except ImportError:  # Windows has no such limits; the caller's time limit is left
        pass
    else:
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        points = DracoPy.decode(sys.stdin.buffer.read()).points
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {error}")
    if points is None or len(points) != count or not np.isfinite(points).all() or np.abs(points).max() >= 1 << 30:
        sys.exit(f"it does not hold {count:,} points")
    sys.stdout.buffer.write(np.rint(points).astype("<i4").tobytes())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
