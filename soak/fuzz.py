"""One reader under atheris, which follows what code the bytes of a file reach: ``python -m soak.fuzz tiff 60``."""

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["napari_fiberburst"]):
    from napari_fiberburst import FiberBurstError
    from soak.files import targets


def main() -> None:
    """Read what atheris makes of a whole file of this kind, for so many seconds; a loss ends it with status 77."""
    name, seconds = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as corpus:
        target = targets(Path(folder))[name]
        Path(corpus, "whole").write_bytes(target.path.read_bytes())

        def read(data: bytes) -> None:
            target.path.write_bytes(data)
            try:
                wrong = target.wrong(target.read())
            except FiberBurstError:
                return
            if wrong is not None:
                raise AssertionError(wrong)

        limits = [f"-max_total_time={seconds}", "-timeout=60", "-rss_limit_mb=6000", "-print_final_stats=1"]
        atheris.Setup([sys.argv[0], *limits, "-artifact_prefix=soak-", corpus], read)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
