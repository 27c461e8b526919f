"""`sw`, and `python -m splatwizard_core`."""

import sys


def start() -> int:
    """Run `sw` and return its exit status; a Ctrl-C is answered in one line while modules are imported, too."""
    try:
        from splatwizard_core.cli.main import main
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return main()


if __name__ == "__main__":
    sys.exit(start())
