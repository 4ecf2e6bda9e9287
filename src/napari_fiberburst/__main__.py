"""The command ``fiberburst``, and ``python -m napari_fiberburst``."""

import sys


def main() -> int:
    """Run the command and return its exit status; see `napari_fiberburst.cli.main`."""
    try:
        from napari_fiberburst.cli import main as run  # takes a second, in which Ctrl-C may come

        return run()
    except KeyboardInterrupt:
        print("\nfiberburst: interrupted; nothing was written", file=sys.stderr)
        return 130  # 128 + SIGINT, as shells have it


if __name__ == "__main__":
    sys.exit(main())
