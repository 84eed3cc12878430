"""Entry point of the `tumble` command, which is also `python -m tumble`."""

import sys


def main() -> None:
    """The command line (`cli.main`); Ctrl-C is one line also during the half second in which that is imported."""
    try:
        from tumble.cli import main as command
    except KeyboardInterrupt:
        print("tumble: interrupted; repeat the command", file=sys.stderr)
        raise SystemExit(130) from None
    command()


if __name__ == "__main__":
    main()
